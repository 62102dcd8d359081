"""GET /metrics, parsed by Prometheus' parser."""

from prometheus_client.parser import text_string_to_metric_families

from rig import ended, long_train, wait_for


def read(text):
    found = {}
    for family in text_string_to_metric_families(text):
        assert family.documentation.endswith(".")
        for sample in family.samples:
            labels = tuple(value for _, value in sorted(sample.labels.items()))
            key = (sample.name, *labels) if labels else sample.name
            assert key not in found
            found[key] = sample.value
    return found


def test_metrics_before_and_after_plans_and_a_stop(board, daemon):
    def read_metrics():
        response = daemon.client.get("/metrics")
        assert response.headers["content-type"].startswith("text/plain; version=0.0.4")
        return read(response.text)

    before = read_metrics()
    assert before["optodrive_board_state", "DISARMED"] == before["optodrive_link_up"] == 1
    assert before["optodrive_pulses_total", "executed"] == 0
    assert "optodrive_plan_headroom_kelvin" not in before
    daemon.arm()
    plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=0.2))["plan"]
    daemon.finished(plan)
    daemon.call("POST", "/v1/plans", json=long_train())
    wait_for(lambda: len(board.of("pulse")) > 15, "pulses")
    wait_for(lambda: read_metrics()["optodrive_lease_age_seconds_count"] > 10, "leases")
    daemon.call("POST", "/v1/stop")
    wait_for(lambda: read_metrics()["optodrive_plans_total", "stopped"], "the plan's end")
    at_full_power_s = 0.010 * daemon.state()["totals"]["executed"] * 1.0 / 2.45
    wait_for(
        lambda: read_metrics()["optodrive_laser_on_seconds_total"] >= 0.99 * at_full_power_s,
        "the board's next word of it",
    )
    assert read_metrics()["optodrive_laser_on_seconds_total"] < 1.2 * at_full_power_s + 0.01
    after = read_metrics()
    assert after["optodrive_plans_total", "done"] == after["optodrive_plans_total", "stopped"] == 1
    assert after["optodrive_pulses_total", "executed"] == daemon.state()["totals"]["executed"] > 10
    assert after["optodrive_first_light_seconds_bucket", "+Inf"] == after["optodrive_first_light_seconds_count"] == 2
    assert after["optodrive_underruns_total"] == daemon.state()["board"]["underruns"]
    assert 0 < after["optodrive_plan_headroom_kelvin"] < 380
    assert 0.2 < after["optodrive_lease_age_seconds_sum"] / after["optodrive_lease_age_seconds_count"] < 1.0
    assert after["optodrive_lease_slack_seconds"] <= 0.8
    assert after["optodrive_lease_seconds"] == 1.0


def test_faults_are_counted_once_by_name(armed):
    engine = armed
    plan = engine.submit_sequence(_frames(engine), "asked").result()
    ended(engine, plan)
    engine._planner._progress_at_s = -1e9  # as if it had stalled: no lease from now on
    engine._planner._pending_count = 1
    wait_for(lambda: engine.board_state == "FAULT", "the lease to lapse")
    # The state arrives with a report of the link process, which the engine counts in its next turn.
    wait_for(lambda: ("optodrive_board_faults_total", "LINK") in read(engine.render_metrics()), "the count")
    for _ in range(3):
        assert read(engine.render_metrics())["optodrive_board_faults_total", "LINK"] == 1
    engine._planner._pending_count = 0


def _frames(engine):
    from optodrive.planning.stimuli.pattern_registry import build_pattern

    return build_pattern("pixel", {}, engine.display.config)
