"""Where runs go: tables, Rerun recordings, pictures."""

import os

# What Rerun's writers meet is raised as an error and told in a line; their own log would tell it again.
os.environ.setdefault("RUST_LOG", "error,re_grpc_client=off,re_sdk=off,re_log_encoding=off")
