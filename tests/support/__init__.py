"""What several tests share: small robots and plans, cases, references, checks."""
