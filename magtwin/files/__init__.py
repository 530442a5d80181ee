"""Files: where they are, what they are, how large they may be, and how outputs are written."""
