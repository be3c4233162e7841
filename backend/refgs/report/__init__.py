"""Evaluate runs and write the report page."""
