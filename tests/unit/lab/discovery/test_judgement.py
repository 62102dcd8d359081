"""Free runs are fitted without what is held out, and compared there."""

import numpy as np
import pytest

from foreign_systems import first_order_model
from optodrive.lab.discovery.fitting import Point, Simulation, Terms
from optodrive.lab.discovery.forms import ABOVE
from optodrive.lab.discovery.held_out import Split
from optodrive.lab.discovery.judgement import Judge
from optodrive.lab.discovery.memory import NONE
from optodrive.lab.discovery.model import Record

T_S = 0.05 * np.arange(200)


def build_point(simulation, ceiling):
    """Return the model of a store whose reading ends at a ceiling."""
    numbers = np.array([[-1.0, ceiling, 0.0, 0.0]])
    free, low, high = np.array([[True, True, False, False]]), np.full((1, 4), -10.0), np.full((1, 4), 10.0)
    return Point(simulation.start, Terms(np.array([[1, ABOVE, 0, -1, NONE]]), numbers, free, low, high))


def build_record(simulation, ceiling):
    flow = 2.0 + np.sin(2.0 * T_S)
    record = Record(T_S, flow, np.zeros(len(T_S)))
    return Record(T_S, flow, simulation.run(record, build_point(simulation, ceiling))[0])


def test_an_answer_that_saw_what_a_split_holds_out_begins_a_fit_and_is_never_its_result():
    model = first_order_model("level", "flow", (1.0, 0.1, 10.0), (1.0, 0.1, 10.0), 0.0)
    simulation = Simulation(model)
    ceilings = (1.2, 1.5)
    records = [build_record(simulation, ceiling) for ceiling in ceilings]
    everything, nothing = np.full(len(T_S), True), np.full(len(T_S), False)
    splits = [Split("second", (everything, nothing)), Split("first", (nothing, everything))]
    judge = Judge(simulation, records, splits, np.full(1, 1e-6))
    # The second start is beyond all levels, where no derivative leads back.
    measured = judge.measure([[build_point(simulation, 1.0)], [build_point(simulation, 9.0)]])
    assert [point.terms.values[0, 1] for point in measured.points] == pytest.approx(ceilings, rel=1e-3)
    assert (measured.rmse[:, 0] < 1e-3).all()
    assert (measured.rmse[:, 1] > 0.1).all()
