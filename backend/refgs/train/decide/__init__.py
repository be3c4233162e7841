"""Decide, for each scene, what a training needs, and what it can do without."""
