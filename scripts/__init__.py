"""Programs of the repository that are not part of what is installed."""
