"""`python -m scripts.demo jar --out DIR`: photograph the jar of `refgs demo`."""

from scripts.demo import jar
from scripts.demo.photograph import main

if __name__ == "__main__":
    main("scripts.demo", {"jar": jar.build})
