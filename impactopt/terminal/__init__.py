"""What a user reads on the terminal: progress, tables, bad input as a plain message. It is light to load."""
