"""Writers of the files that operators use."""
