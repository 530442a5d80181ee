"""Commands that build data sets, and that train, evaluate and export predictors."""
