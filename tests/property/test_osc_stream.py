"""A source of OSC at 90 Hz in virtual time, through bridge, planner and board: the judge reads the board's log.

`test_osc_bridge.py` has the hour, at a display that draws for a stated time.
"""

import numpy as np
import pytest
from test_stream_throughput import LEADS_S, STEP_S, StreamRig

from optodrive.client.osc import OscBridge, OscHeights, Place
from optodrive.client.osc_packets import build_message, parse_packet
from optodrive.client.stream import FrameCounts
from optodrive.core.types.stimuli import FrameSequence, TactileFrame

RATE_HZ, SECONDS = 90.0, 20.0
HEIGHT_UM = 60.0


class VirtualSource:
    """Port and stream of a bridge on the rig: the source lights the next of some pixels with each packet."""

    def __init__(self, rig, pixels):
        self.rig, self.pixels, self.replies = rig, pixels, []
        self.begin_s, self.number = rig.clock.now_s(), 0

    def receive(self, wait_s):
        due = int((self.rig.clock.now_s() - self.begin_s) * RATE_HZ + 1e-6)
        if due < self.number:
            self.rig.run(STEP_S)
            return []
        packets = [self.build(number) for number in range(self.number, due + 1)]
        self.number = due + 1
        return packets

    def build(self, number):
        count = len(self.pixels)
        before, now = (self.pixels[(number + k) % count] for k in (-1, 0))
        values = (before, 0.0, now, HEIGHT_UM) if count > 1 else (now, HEIGHT_UM)
        return build_message("/pixel", *values)

    def send_packet(self, data, place):
        self.replies.append(parse_packet(data)[0].arguments)

    def send(self, heights_um):
        frame = FrameSequence((TactileFrame("f", 0.0, 3600.0, 1e-6 * heights_um),))
        report = self.rig.submit(frame, self.rig.remote.epoch, streamed=True, lists_pulses=False).result()
        self.rig.records.append(self.rig.store.find(report.plan))
        return len(self.rig.records) - 1

    def results(self):
        return []

    @property
    def counts(self):
        shown = self.rig.count_shown()
        return FrameCounts(shown, sum(each.status == "superseded" for each in self.rig.records), 0)


class ReplyPort:
    def __init__(self, source):
        self.receive, self.send = source.receive, source.send_packet


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 4])
def test_a_source_at_90_hz_is_drawn_by_its_newest_frames_and_reported(monkeypatch, count):
    rig = StreamRig(monkeypatch)
    source = VirtualSource(rig, range(200, 200 + count))
    heights = OscHeights(437, 1.0)
    bridge = OscBridge(
        ReplyPort(source), source, heights, None, pytest.fail, reply=Place("127.0.0.1", 1), now_s=rig.clock.now_s
    )
    while rig.clock.now_s() < source.begin_s + SECONDS + STEP_S:
        bridge.step()
    rig.finish()
    shown = rig.count_shown()
    assert len(rig.list_gate_times_s()) == shown  # a frame lights one pixel
    assert max(rig.list_ages_s()) < LEADS_S
    sent_hz, shown_hz, _ = np.array(source.replies).T
    assert len(source.replies) == pytest.approx(SECONDS, abs=1)
    assert sent_hz == pytest.approx(RATE_HZ, abs=2.0)
    assert shown_hz.mean() == pytest.approx(shown / SECONDS, rel=0.05)
    assert shown > 0.9 * RATE_HZ * SECONDS
    assert rig.session.board.underruns == 0
