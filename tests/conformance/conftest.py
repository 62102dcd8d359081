"""Fixtures of the kinds of boards: cores in this process in virtual time, and processes in real time."""

import sys
from functools import cache, partial
from pathlib import Path

import pytest
from process_board import PROCESS_KINDS
from virtual_board import EmulatedBoard, PicoBoard, VirtualKind

sys.path.append(str(Path(__file__).parents[1] / "pico"))

from emulated_pico import EmulatedDigitalPico, EmulatedPico, PicoImage
from emulated_usb_pico import EmulatedUsbPico

from c_core import InterruptedCBoard, SeededCBoard, build_library
from firmware_ports import build_emulated_chip
from optodrive.link.simulator.board_core import BoardCore

PICOS = {"pico": EmulatedPico, "pico-usb": EmulatedUsbPico, "pico-xy2": EmulatedDigitalPico}
"""The Pico by the port of its host, or with a digital scan head."""


@pytest.fixture(scope="session")
def virtual(tmp_path_factory):
    """Return a function for a virtual kind by name, or a mutant of the core in C. Each is built once."""
    folder = tmp_path_factory.mktemp("core")

    @cache
    def build(name, mutant=0):
        if name == "python":
            return VirtualKind(name, BoardCore)
        if name in PICOS:
            built = folder / f"{name}-{mutant}"
            built.mkdir()
            return VirtualKind(name, partial(PICOS[name], PicoImage(built, mutant)), make_board=PicoBoard)
        if name == "qemu":
            return VirtualKind(name, build_emulated_chip(folder, mutant), make_board=EmulatedBoard)
        if name == "interrupted":
            return VirtualKind(name, partial(InterruptedCBoard, build_library(folder, mutant)))
        return VirtualKind(name, partial(SeededCBoard, build_library(folder, mutant)))

    return build


@pytest.fixture(scope="session")
def ready(tmp_path_factory):
    """Return a function that builds a kind's program, or a mutant of it, once for all threads."""
    boards = tmp_path_factory.mktemp("boards")

    @cache
    def build(name, mutant):
        (kind,) = [kind for kind in PROCESS_KINDS if kind.name == name]
        return kind.ready(boards / f"{name}-{mutant}", mutant)

    return build
