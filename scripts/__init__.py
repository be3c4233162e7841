"""Hold scripts that run only in a clone of this repository. They are not installed with the trainer or the Blender extension."""
