"""Hold programs of the repository that are installed neither with the trainer nor with the extension."""
