"""Pictures of benches, in the style of `impactopt.report.pictures`; one a file."""
