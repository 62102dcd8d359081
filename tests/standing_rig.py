"""Standing pages in virtual time: the planner's real page, queue and session, and what its board's log says of them."""

import numpy as np

from link_service_rig import OPERATOR, WEB
from optodrive.core.errors import OptodriveError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.daemon.api.live_stream import REFRESH_MAX_S, REFRESH_MIN_S
from optodrive.daemon.engine import plan_making, planner
from optodrive.daemon.engine.page_refresh import PageRefresh
from optodrive.daemon.engine.plan_making import PlanningRequest
from optodrive.daemon.push import BuiltRequest, Push
from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_board_requirements, build_port_settings
from optodrive.link.simulator.guards import build_settings
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import SequencePlanner
from optodrive.planning.stimuli.standing_page import REFRESH_PERIOD_S
from planner_rig import PlannerRig


def build_display(name="display-437", **limits):
    """Return a shipped display with other limits."""
    config = load_config(name)
    return DisplayModel.from_config(
        config.model_copy(update={"limits": config.limits.model_copy(update=limits)}) if limits else config
    )


def build_page(display, pixels, height_um):
    """Return the heights of a page whose pixels have one height, or one each."""
    target_m = np.zeros(len(display.layout))
    target_m[list(pixels)] = np.asarray(height_um) * 1e-6
    return target_m


class StandingRig(PlannerRig):
    """A planner whose newest frame stands, refreshed by the rules of a standing stream. Planning takes `planning_s`.

    page_m: the frame that stands, None without one
    refusals: of new frames and refreshes; limited_by: caps that took light from them, as their client is told
    """

    def __init__(self, monkeypatch, display, **options):
        config = display.config
        options |= {"requirements": build_board_requirements(config)}
        options |= {"settings": build_settings(build_port_settings(config).own_settings)}
        super().__init__(monkeypatch, display=display, **options)
        self.display, self.planning_s = display, 0.002
        self.page = PageRefresh(display.layout, self.clock, self.remote.board_s, lambda: self.queue.lead_s)
        self.page_m, self.refusals, self.limited_by, self.fingers_moved = None, [], set(), False
        self._began_s = -np.inf
        make_plan = plan_making.make_plan

        def make_plan_in_time(*arguments):
            plan = make_plan(*arguments)
            self.pass_time(self.planning_s)
            return plan

        monkeypatch.setattr(planner, "make_plan", make_plan_in_time)
        # Priorities mean nothing in virtual time, and each change costs as much as a plan.
        monkeypatch.setattr(planner, "set_realtime_priority", lambda priority: None)
        monkeypatch.setattr(planner, "use_usual_priority", lambda: None)

    def pass_time(self, duration_s):
        """Let the link process and the loop run while the planner computes."""
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s:
            super(PlannerRig, self).run()
            self.remote.connection.receive()
            self.queue.update_jobs(self.remote.pop_refusal())
            self.queue.start_next()

    def show(self, page_m):
        """Let a new frame stand. Return its report, None if it was refused."""
        self.page_m = page_m
        return self._push(refreshes=False)

    def touch(self, places):
        """Report the places of fingers, as a tracker does."""
        self.page.update_fingers(self.clock.now_s(), places)
        self.fingers_moved = True

    def end_page(self):
        """End the frame, as the end of its client does."""
        self.page_m = None
        blank = FrameSequence((TactileFrame("", 0.0, 1.0, np.zeros(len(self.display.layout))),))
        self.submit(blank, self.remote.epoch, streamed=True)

    def run(self, duration_s=0.002):
        super().run(duration_s)
        if self.page_m is None:
            return
        age_s = self.clock.now_s() - self._began_s
        if age_s >= REFRESH_MAX_S or (self.fingers_moved and age_s >= REFRESH_MIN_S):
            self._push(refreshes=True)

    def _push(self, refreshes):
        self._began_s, self.fingers_moved = self.clock.now_s(), False
        sequence = FrameSequence((TactileFrame("page", 0.0, 3600.0, self.page_m),))
        push = Push("page", {}, self._began_s, self.remote.epoch, "", True, False, True, refreshes)
        built = BuiltRequest(sequence)
        request = PlanningRequest(lambda: built, push, self.remote.board_s(), select=self.page.select)
        try:
            report = self.planner.submit(request).result()
        except OptodriveError as error:
            self.refusals.append(error)
            self.page_m = None
            return None
        self.limited_by |= set(report.summary.limited_by)
        return report

    def stand(self, page_m, duration_s, send_period_s=np.inf, places=()):
        """Let a frame stand for a time, sent again after each period, under fingers whose tracker reports at 100 Hz."""
        end_s, send_s, report_s = self.clock.now_s() + duration_s, self.clock.now_s(), self.clock.now_s()
        while self.clock.now_s() < end_s:
            if places and self.clock.now_s() >= report_s:
                self.touch(places)
                report_s += 0.01
            if self.clock.now_s() >= send_s:
                self.show(page_m)
                send_s += send_period_s
            self.run()

    def stop(self):
        self.await_result(OPERATOR, self.request(OPERATOR, "stop"))
        self.await_result(WEB, self.request(WEB, "disarm"))

    # --- the board's log

    def list_pulses(self, since_s=0.0):
        """Return (gate on, gate off, duty) of the pulses since a time, [n, 3]."""
        pulses = [event for event in self.log if event["event"] == "pulse" and event["on_us"] >= 1e6 * since_s]
        return np.array([[event[key] for key in ("on_us", "off_us", "duty")] for event in pulses]).reshape(-1, 3)

    def compute_light_j(self, since_s):
        """Return the energy of all pulses since a time, J."""
        on_us, off_us, duty = self.list_pulses(since_s).T
        return float(np.sum((off_us - on_us) * duty)) * 1e-6 / 65535 * self.display.config.laser.max_power_w

    def find_longest_dark_s(self, since_s):
        """Return the longest time without light from a time until now, s."""
        on_us, off_us, _ = self.list_pulses(since_s).T * 1e-6
        return float(np.max(np.append(on_us, self.clock.now_s()) - np.insert(off_us, 0, since_s)))

    def list_events(self, event):
        """Return what the board's log says of one kind of event, but pulses and gate edges."""
        return [entry for entry in self.log if entry["event"] == event]


def compute_plan_light_j(display, page_m, duration_s):
    """Return the light that the same frame gets from a cold display as a plan that repeats it, J."""
    repeats = range(round(duration_s / REFRESH_PERIOD_S))
    frames = tuple(TactileFrame(str(k), k * REFRESH_PERIOD_S, REFRESH_PERIOD_S, page_m) for k in repeats)
    plan = SequencePlanner(display, FrameSequence(frames), *display.build_cold_state()).plan_until(duration_s).plan
    begun = plan.start_s < duration_s
    return float(plan.power_w[begun] @ plan.width_s[begun])
