"""Tables: rows of words in text files, and the words and units in the names of columns."""
