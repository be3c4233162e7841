"""Render the photos of the jar for `refgs demo`: `python -m scripts.demo jar --out DIR`."""

from scripts.demo import jar
from scripts.demo.photograph import main

if __name__ == "__main__":
    main("scripts.demo", {"jar": jar.build})
