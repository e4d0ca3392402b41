"""Reports of a result: tables on the terminal, pictures, a page for a browser."""
