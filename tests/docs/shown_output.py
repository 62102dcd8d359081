"""Comparison of the output that a page shows with the real one."""

import re
from difflib import unified_diff

NOTE = re.compile(r"\s{2,}# .*$")
COMPILATION = re.compile(r"^optodrive: compiling kernels.*\n", re.M)
"""Printed where the cache of kernels is cold, which is none of the page's business."""


def find_difference(shown, real):
    """Return how the real output differs from the shown one, '' if it does not.

    In the shown output, … is any text within its line, a line of … alone is any number of lines, and a note follows two
    spaces and a #. Everything else is compared to the letter, except spaces at the ends of lines.
    """
    expected = [NOTE.sub("", line).rstrip() for line in shown.splitlines()]
    lines = [line.rstrip() for line in COMPILATION.sub("", real).splitlines()]
    pattern = "".join(r"(?:.*\n)*?" if line == "…" else _build_pattern(line) for line in expected)
    if re.fullmatch(pattern, "".join(f"{line}\n" for line in lines)):
        return ""
    return "\n".join(unified_diff(expected, lines, "shown", "real", n=1, lineterm=""))


def _build_pattern(line):
    return ".*".join(re.escape(part) for part in line.split("…")) + r"\n"
