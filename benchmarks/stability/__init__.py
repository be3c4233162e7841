"""Stiff and extreme cases, through every kernel and through training: `refgs stability [--only WORD]`. docs/stability.md keeps the table.

A module a group of cases, each a list CASES.
"""
