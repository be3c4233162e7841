"""Test every kernel and the training in extreme and ill-conditioned cases: `refgs stability [--only WORD]`.

Each module has a group of cases, in its list CASES. docs/stability.md keeps the printed tables.
"""
