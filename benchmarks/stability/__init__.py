"""Test every kernel and the training in extreme and ill-conditioned cases: `refgs stability [--only WORD]`.

Each module tests one group of cases, which are in its list CASES. docs/stability.md has the results.
"""
