"""Run stiff and extreme cases through every kernel and through training: `refgs stability [--only WORD]`.

Each module is a group of cases, a list CASES. docs/stability.md keeps the tables.
"""
