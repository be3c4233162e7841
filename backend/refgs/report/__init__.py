"""Evaluate trained runs, and write the report page about them."""
