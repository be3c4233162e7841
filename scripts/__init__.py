"""Programs of the repository that are not installed with the trainer or the extension."""
