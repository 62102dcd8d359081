"""Terms: physical effects that extend the nominal pixel, and everything that the package asks of one.

Each class in a module of `optodrive.physics.terms` is one term: its parameters, its kernels in the compiled pixel, the
heat that it may add to the limiter's bound, and the hypotheses by which a diagnosis searches for it. No other module
names a term that it does not implement itself.
"""

from collections.abc import Callable, Mapping
from itertools import product
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.device.servo import Servo
from optodrive.physics.hypothesis import (
    FreeParameter,
    Hypothesis,
    RecordingScope,
    TermParameter,
    describe_signals,
)

TermValues = Mapping[str, float]
"""A term's parameters by name, SI."""

ABSORBER, GAS, WALL, NEIGHBOUR, SENSOR, FIRST_FOLLOWER = range(6)
"""Rows of one pixel's state vector, all in K above ambient.

The pixel's absorber, gas and wall, the absorber of an illuminated neighbour, and the reading of a lagging thermometer;
the followers of each term come after them.
"""

POWER_W, FULL_W, SINCE_EDGE_S, DOSE, ILLUMINATED_PIXEL, AMBIENT_K, BRIDGE_FLOW_W, FAR_END_K = range(8)
TIME_S, SESSION_TIME, IS_TARGET, MEMBRANE_DRIVE_K, PANEL_HELD = range(8, 13)
"""Entries of the context vector that kernels receive besides the states.

Commanded power and full power; time since the last gate edge; dose so far over the recording's largest; index of the
illuminated pixel, or ELSEWHERE; ambient temperature; heat flow through the bridge and temperature rise of its far end;
time in the run, and in the session from −1 to 1; 1 if the light falls on this very pixel, else 0; gas rise that drives
the membrane; 1 while the states of the panel stay as they are, which light on other pixels has changed.
"""
CONTEXT_SIZE = 13
ELSEWHERE = -1
"""Illuminated pixel of a pulse that heats neither the pixel nor one of its neighbours: it only acts on the laser."""

Modifier = Callable[[FloatArray, FloatArray, int, FloatArray, float], float]
RateWriter = Callable[[FloatArray, FloatArray, int, FloatArray, FloatArray], None]


@kernel
def add_follower(v: FloatArray, y: FloatArray, s: int, c: FloatArray, x: float) -> float:
    """Add the term's first follower, as a wall that stands on another warm part does."""
    return float(x + y[s])


class Kernels(NamedTuple):
    """A term's part in the compiled pixel, one function per hook. None leaves the pixel as it is.

    Each function takes (v, y, s, c, x): v the term's parameters in order, y the states, s the row of the term's first
    follower, c the context, x the value without the term. It returns the value with the term; `rates` writes to x.

    optical_power: W on the absorber; decaying_power: W on it after the gate has closed; heat_capacity: J/K of the
    absorber; bridge_resistance: K/W; heat_loss: W from the absorber to ambient; wall_rise: rise of the bridge's far
    end, K; rates: dy/dt; membrane_drive, force_drive: gas rise that lifts the membrane and that pushes against a
    finger, K; displacement: m; force: N; sensor_reading: rise that the thermometer shows, K; sensor_lag: time constant
    of the thermometer, s
    """

    optical_power: Modifier | None = None
    decaying_power: Modifier | None = None
    heat_capacity: Modifier | None = None
    bridge_resistance: Modifier | None = None
    heat_loss: Modifier | None = None
    wall_rise: Modifier | None = None
    rates: RateWriter | None = None
    membrane_drive: Modifier | None = None
    force_drive: Modifier | None = None
    displacement: Modifier | None = None
    force: Modifier | None = None
    sensor_reading: Modifier | None = None
    sensor_lag: Modifier | None = None


class OperatingEnvelope(NamedTuple):
    """Largest values that a display can reach.

    absorber_k: rise of one absorber; summed_absorbers_k: sum of all absorbers' rises under all beams; full_w: power of
    the strongest laser; all_power_w: that of all lasers together; r_k_per_w: resistance of a hot bridge; c_min_j_per_k,
    c_max_j_per_k: the smallest and the largest heat capacity of an absorber; tau_g_s: time constant of the gas;
    gas_share: share of the gas's rise that a touch surface takes.
    """

    absorber_k: float
    summed_absorbers_k: float
    full_w: float
    all_power_w: float
    r_k_per_w: float
    c_min_j_per_k: float
    c_max_j_per_k: float
    tau_g_s: float
    gas_share: float


class HeatGainBound(NamedTuple):
    """Upper bound on the heat that a term adds.

    Factors on the absorbed power, on the heat capacity of a hot absorber, and on the time constant with which heat
    leaves an absorber for its wall; an additional rise of everything, K; and one of absorbers, K per rate of rise of
    what they stand on, K/s, because they return heat of an earlier time.
    """

    power_factor: float = 1.0
    capacity_factor: float = 1.0
    delay_factor: float = 1.0
    uniform_rise_k: float = 0.0
    absorber_age_s: float = 0.0


NO_HEAT_GAIN = HeatGainBound()


class BySignal(NamedTuple):
    """One number for each recorded signal."""

    temperature: float = 0.0
    displacement: float = 0.0
    force: float = 0.0
    mirrors: float = 0.0


class RecordedRun(NamedTuple):
    """The run that an instrument records: session time from −1 to 1, and its largest power relative to full power."""

    session_time: float = 0.0
    power: float = 1.0


def build_signal_parameters(
    unit: str, default: float, low: float, high: float, source: str, names: tuple[str, ...] = BySignal._fields
) -> tuple[TermParameter, ...]:
    """Return one parameter for each signal, without effect at 0."""
    return tuple(TermParameter(name, unit, default, low, high, source, neutral=0.0) for name in names)


class Term:
    """One physical effect. A term overrides the members that differ from the defaults, which leave the model unchanged.

    Identity: key, the term's name in files; label, a clause that completes "The nominal model is wrong because …".
    Physics: requires, keys of terms that it builds on; states, shared rows of the state vector that only it moves;
    followers, names of its own state rows; has_laser_state and has_panel_state, whether these belong to the laser or to
    the panel, which all pixels share; kernels; in_pixel, False for a term that only the limiter's bound accounts
    for; couples_neighbours, whether light on one pixel heats the pixels around it; is_fast, whether it acts within a
    gas time constant; cannot_add_heat, whether it never makes anything hotter, see also `bound_heat_gain`.
    Diagnosis: signature, where the effect shows in recorded data, empty if it is no possible cause of a discrepancy;
    subsystems, the kinds of recording that can show it; only_records, whether it acts by `record` alone;
    varies_between_runs, whether repeats of one drive differ by it;
    is_exact, whether the effect has no other form than the term's, but for its share in each signal;
    starts_by_signal, of a term with one number per signal: where the search for one of all and for each begins;
    is_linear and fit_every_start as in `Hypothesis`; detection_limit, replaces the computed smallest visible effect;
    remedy, what to do at an instrument to see whether it is this, in a sentence; removes_zero, whether the zero of a
    signal on which it acts is equal in all runs; twin, the cause that no recording tells from it, of any law.
    """

    key: str
    label: str = ""
    parameters: tuple[TermParameter, ...] = ()
    requires: tuple[str, ...] = ()
    states: tuple[int, ...] = ()
    followers: tuple[str, ...] = ()
    has_laser_state: bool = False
    has_panel_state: bool = False
    kernels: Kernels = Kernels()
    in_pixel: bool = True
    couples_neighbours: bool = False
    is_fast: bool = False
    cannot_add_heat: bool = False
    signature: str = ""
    subsystems: tuple[str, ...] = ("pixels",)
    only_records: bool = False
    varies_between_runs: bool = False
    is_exact: bool = False
    starts_by_signal: tuple[float, ...] = ()
    is_linear: bool = False
    fit_every_start: bool = False
    detection_limit: str = ""
    remedy: str = ""
    removes_zero: bool = False
    twin: str = ""

    @property
    def is_instrument(self) -> bool:
        """Whether the term acts in an instrument, rather than in the pixel, its light or the mirrors."""
        # An instrument changes what is read, and nothing in the pixel.
        kernels = self.kernels._replace(sensor_reading=None, sensor_lag=None)
        return self.in_pixel and self.subsystems != ("mirrors",) and not any(kernels)

    @property
    def row_length(self) -> int:
        """Length of the row by which kernels receive the term's numbers."""
        return len(self.parameters)

    def pack(self, values: TermValues) -> FloatArray:
        """Return the numbers of the term as kernels receive them, [row_length]."""
        return np.array([values[item.name] for item in self.parameters])

    @property
    def moves_membrane(self) -> bool:
        """Whether the term changes the displacement that a given gas rise causes."""
        return self.kernels.membrane_drive is not None or self.kernels.displacement is not None

    def bound_heat_gain(self, values: TermValues, envelope: OperatingEnvelope) -> HeatGainBound | None:
        """Return an upper bound on the heat that the term adds. The limiter refuses a term without a bound (None)."""
        # None by default: a term whose author did not think of heat is refused, not waved through.
        return NO_HEAT_GAIN if self.cannot_add_heat else None

    def affected_pixel(self, values: TermValues) -> int | None:
        """Return the index of the only pixel that the term affects, or None if it affects all."""
        return None

    def signal_delays(self, values: TermValues) -> BySignal:
        """Return the delays behind the pixel that the term gives to the recorded signals, s."""
        return BySignal()

    def signal_rates(self, values: TermValues) -> BySignal:
        """Return the share by which the stated times of each signal run faster than true ones."""
        return BySignal()

    def record(
        self, values: TermValues, signal: str, t_s: FloatArray, value: FloatArray, run: RecordedRun
    ) -> FloatArray:
        """Return an instrument's record [n] of a pixel's signal, one of `BySignal`, at these times of a run."""
        return value

    def servo(self, values: TermValues) -> Servo | None:
        """Return the servo that the mirrors follow under the term, or None if it does not concern them."""
        return None

    def free(self, *names: str) -> FreeParameter:
        """Return the number to be fitted that these parameters share."""
        return FreeParameter(self.key, names, next(item for item in self.parameters if item.name == names[0]))

    def build_hypotheses(self, scope: RecordingScope) -> list[Hypothesis]:
        """Return the hypotheses on the term that such a recording can show.

        By default one, with every parameter free and every combination of the parameters' starts.
        """
        if self.starts_by_signal:
            return self._build_hypotheses_by_signal(scope)
        grid = {item.name: item.starts or (item.default,) for item in self.parameters}
        starts = tuple(dict(zip(grid, values, strict=True)) for values in product(*grid.values()))
        free = tuple(self.free(name) for name in grid)
        return [Hypothesis(self.key, self.key, starts, free, self.is_linear, self.fit_every_start)]

    def _build_hypotheses_by_signal(self, scope: RecordingScope) -> list[Hypothesis]:
        names = tuple(item.name for item in self.parameters)
        return [
            Hypothesis(
                self.key,
                f"{self.key} of {describe_signals(acting)}",
                tuple(dict.fromkeys(names, 0.0) | dict.fromkeys(acting, start) for start in self.starts_by_signal),
                (self.free(*acting),),
                self.is_linear,
            )
            for acting in scope.list_signal_sets(names)
        ]
