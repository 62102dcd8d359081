"""Import paths of the conformance suite and of the emulated Pico."""

import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
sys.path.insert(0, str(TESTS / "conformance"))
sys.path.append(str(TESTS / "pico"))
