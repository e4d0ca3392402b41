"""Reports of a result: tables and plain messages on the terminal, pictures, a page for a browser."""
