"""Two places one after the other, whose intensities are compared."""

from optodrive.core.types.stimuli import FrameSequence, HeightTrain
from optodrive.device.config import Config
from optodrive.device.sensitivity_map import replace_sensitivity_map
from optodrive.planning.stimuli.intensity import IntensityModel
from optodrive.planning.stimuli.pixel_lattice import Lattice

DURATION_S, PAUSE_S, PERIOD_S = 0.4, 0.4, 0.04


def build_comparison(
    config: Config,
    where: str,
    first: int | None,
    second: int | None,
    first_intensity: float,
    second_intensity: float,
) -> FrameSequence:
    """Build two vibrations of 0.4 s at 25 Hz, 0.4 s apart, by default both in the middle of the display.

    Intensities are those of a person of sensitivity 1 everywhere, because a comparison measures the sensitivity. Raises
    InputError (target_unreachable).
    """
    (middle,) = Lattice.from_config(config).pixels_around(None, [(0, 0)], where, "a place for the stimulus")
    model = IntensityModel(replace_sensitivity_map(config, None))
    trains = []
    for number, (pixel, name, intensity) in enumerate(
        ((first, "first", first_intensity), (second, "second", second_intensity))
    ):
        place = middle if pixel is None else pixel
        target_m = model.solve_train_m(place, PERIOD_S, DURATION_S, intensity, f"{where}: {name}_intensity")
        trains.append(HeightTrain(place, number * (DURATION_S + PAUSE_S), DURATION_S, PERIOD_S, target_m))
    return FrameSequence(trains=tuple(trains))
