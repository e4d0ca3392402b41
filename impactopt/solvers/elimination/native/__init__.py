"""C for the SQP's linear algebra."""
