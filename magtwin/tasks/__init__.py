"""Tasks on files: data sets, evaluations and localization, for scripts and for the command line."""
