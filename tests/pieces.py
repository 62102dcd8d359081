"""Pieces of the selected tests, for runs that can be resumed."""


def take_piece(tests, text):
    """Return the K-th of N pieces of a list, of which neighbours stay together. text: K/N"""
    number, count = map(int, text.split("/"))
    return tests[len(tests) * (number - 1) // count : len(tests) * number // count]
