"""C code, compiled when it is first needed."""
