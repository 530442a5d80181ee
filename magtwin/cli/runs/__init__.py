"""Commands that make runs, and that show, compare and convert them."""
