"""What a user reads on the terminal: progress, tables, bad input as a plain message. Nothing heavy is loaded."""
