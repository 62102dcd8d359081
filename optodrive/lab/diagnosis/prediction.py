"""The model's answer to a recording's drive: one long vector beside the measured one."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.servo import Servo, follow
from optodrive.lab.diagnosis.dataset import MIRROR_KINDS, PIXEL_KINDS, Dataset
from optodrive.physics.pixel import Pixel
from optodrive.physics.pixel_ode import Active, observe
from optodrive.physics.term import Values
from optodrive.physics.terms import known_terms

BASE = ("R", "C", "tau_g", "kappa", "phi")
"""The nominal parameters that are fitted, all by their logarithms."""
UNITS = {"R": "K/W", "C": "J/K", "tau_g": "s", "kappa": "m/K", "phi": "N/K"}


@dataclass(frozen=True)
class Point:
    """A model: logarithms of the base parameters, and terms with their values."""

    base: tuple[float, ...]
    terms: Mapping[str, Values]

    def pixel(self, epsilon: float) -> Pixel:
        """As the physics takes it."""
        r, c, tau_g, kappa, phi = np.exp(np.array(self.base)).tolist()
        return Pixel(r, c, epsilon, tau_g, kappa, phi)


def predict(data: Dataset, point: Point, epsilon: float = 0.66, power: float = 1.0, late_s: float = 0.0) -> FloatArray:
    """[m]; power: all light so much stronger; late_s: all signals so much later."""
    out = np.zeros(len(data.value))
    pixel = point.pixel(epsilon * power)
    clock = point.terms.get("clock_offset", {})
    lag = point.terms.get("sensor_lag", {})
    late = [late_s + clock.get(name, 0.0) for name in ("temperature", "displacement", "force", "mirrors")]
    late[0] += lag.get("time", 0.0) * lag.get("delay_share", 0.0)
    active = Active.of({key: own for key, own in point.terms.items() if key not in ("clock_offset", "mirror_lag")})
    if any(known_terms()[key].by_run for key in point.terms):
        for scene, places in data.scenes:
            told = observe(scene, pixel, active, (late[0], late[1], late[2]))
            for kind in PIXEL_KINDS:
                if places[kind] >= 0:
                    out[data.blocks[places[kind]].part] = told[kind]
    else:
        for item in data.alike:
            told = observe(item.scene, pixel, active, (late[0], late[1], late[2]))
            for kind, place, rows in item.rows:
                out[data.blocks[place].part] = told[kind][rows]
    servo = Servo(**point.terms["mirror_lag"]) if "mirror_lag" in point.terms else None
    for block in data.blocks:
        commands = data.runs[block.run].commands
        if block.kind in MIRROR_KINDS and commands is not None:
            column = commands[:, 1 + MIRROR_KINDS.index(block.kind)]
            out[block.part] = follow(commands[:, 0], column, block.t_s - late[3], servo)
    return out
