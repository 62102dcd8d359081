"""Streams of a session for the Lab Streaming Layer: each executed pulse, and each trial that counts.

A pulse is published after its stimulus has ended, with the stamp of its gate on: the host's time of the first pulse's,
and from there the board's own ticks. LSL's clock is the computer's CLOCK_MONOTONIC, in which the daemon states that
time.
"""

import json
import time
from collections.abc import Mapping
from typing import Any

from optodrive.core.extras import import_extra
from optodrive.study.presenter import OnBegin, Presentation, Presenter, ignore_begin
from optodrive.study.trial_stimulus import TrialStimulus

PULSE_CHANNELS = (("pixel", ""), ("width", "s"), ("power", "W"), ("board_time", "s"))
CONSUMER_WAIT_S = 0.2
SENDING_S = 2.0
"""Samples of an outlet that is gone are lost; on a computer with other work they leave within milliseconds."""


class LabStreams:
    """Two outlets of a session. Raise InputError (missing_extra) without pylsl."""

    def __init__(self, study: str, participant: str) -> None:
        self._pylsl = import_extra("pylsl", extra="studies")
        irregular = self._pylsl.IRREGULAR_RATE
        self.names = f"optodrive {study} pulses", f"optodrive {study} trials"
        pulses = self._pylsl.StreamInfo(
            self.names[0], "Pulses", len(PULSE_CHANNELS), irregular, "double64", f"optodrive-pulses-{participant}"
        )
        channels = pulses.desc().append_child("channels")
        for label, unit in PULSE_CHANNELS:
            channel = channels.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", unit)
        trials = self._pylsl.StreamInfo(
            self.names[1], "Markers", 1, irregular, "string", f"optodrive-trials-{participant}"
        )
        self._pulses, self._trials = self._pylsl.StreamOutlet(pulses), self._pylsl.StreamOutlet(trials)

    def wait_for_recorder(self) -> None:
        """Wait until both streams are read."""
        for outlet in (self._pulses, self._trials):
            while not outlet.wait_for_consumers(CONSUMER_WAIT_S):
                pass

    def finish(self) -> None:
        """Wait until the last samples have left, of which LSL gives no sign."""
        time.sleep(SENDING_S)

    def publish_pulses(self, shown: Presentation) -> None:
        """Publish the pulses of a presentation on a board, whose host knows when it began."""
        if shown.onset_monotonic_s is None or shown.onset_s is None:
            return
        for pixel, start_s, width_s, power_w in zip(
            shown.pixel, shown.start_s, shown.width_s, shown.power_w, strict=True
        ):
            sample = [float(pixel), width_s, power_w, shown.onset_s + start_s]
            self._pulses.push_sample(sample, shown.onset_monotonic_s + start_s)

    def publish_trial(self, record: Mapping[str, Any]) -> None:
        """Publish the answer of a trial that counts, with the time at which it was on the disk."""
        names = ("trial", "attempt", "condition", "answer", "is_correct", "response_time_s")
        self._trials.push_sample([json.dumps({name: record[name] for name in names if name in record})])


class PublishingPresenter:
    """A presenter whose pulses are published."""

    def __init__(self, presenter: Presenter, streams: LabStreams) -> None:
        self._presenter, self._streams, self.config = presenter, streams, presenter.config

    def present(self, stimulus: TrialStimulus, on_begin: OnBegin = ignore_begin) -> Presentation:
        """Show a stimulus and publish the executed pulses."""
        shown = self._presenter.present(stimulus, on_begin)
        self._streams.publish_pulses(shown)
        return shown

    def wait(self, duration_s: float) -> None:
        """Let time pass between two stimuli."""
        self._presenter.wait(duration_s)
