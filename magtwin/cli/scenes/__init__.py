"""Commands that author scenes and robots, check them and export them."""
