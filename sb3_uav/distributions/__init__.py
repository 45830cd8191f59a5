"""Random maps and task values, as plain arrays."""
