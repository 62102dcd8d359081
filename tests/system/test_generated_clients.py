"""Clients that other programs generate from the OpenAPI document, at a daemon with the embedded simulated board."""

import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from optodrive.cli.docs import locate_shipped_folder
from rig import TOKEN, Daemon, wait_for

DOCUMENT = locate_shipped_folder("docs") / "reference" / "openapi.json"
NODE_MODULES = Path(sys.prefix).parent / ".node" / "node_modules"
TYPESCRIPT = """
import createClient from "openapi-fetch";
import type { components, paths } from "./optodrive.js";

declare const process: { argv: string[] };
const [baseUrl, token] = process.argv.slice(2);
const api = createClient<paths>({ baseUrl, headers: { Authorization: `Bearer ${token}` } });

function known<T>(answer: { data?: T; error?: components["schemas"]["Problem"] }): T {
  if (answer.data === undefined) throw new Error(answer.error?.code);
  return answer.data;
}

known(await api.POST("/v1/arm"));
const body: components["schemas"]["FrameSequence"] = {
  frames: [{ show_at_s: 0, duration_s: 0.5, target_um: { "3": 50 } }],
  trains: [{ pixel: 4, start_s: 0.6, duration_s: 0.2, period_s: 0.05, target_um: 60 }],
};
const parameters = { params: { path: { name: "dot" }, query: { policy: "trim" } } } as const;
const pushes = [await api.POST("/v1/plans", { body }), await api.POST("/v1/patterns/{name}", parameters)];
const ended: components["schemas"]["PlanReport"][] = [];
for (const push of pushes) {
  const path = { plan_id: known(push).plan };
  let plan = known(await api.GET("/v1/plans/{plan_id}", { params: { path } }));
  while (!["done", "failed", "stopped"].includes(plan.status)) {
    await new Promise((wake) => setTimeout(wake, 20));
    plan = known(await api.GET("/v1/plans/{plan_id}", { params: { path } }));
  }
  ended.push(plan);
}
const state = known(await api.GET("/v1/state"));
const refused = await api.GET("/v1/plans/{plan_id}", { params: { path: { plan_id: "none" } } });
console.log(JSON.stringify({
  statuses: ended.map((plan) => plan.status),
  executed: state.totals.executed,
  state: state.board.state,
  refused: refused.error?.code,
}));
"""


@pytest.fixture
def embedded(tmp_path):
    folder = tmp_path / "daemon"
    folder.mkdir()
    daemon = Daemon(folder, None, name="display-16")
    yield daemon
    daemon.stop()


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """Return the modules of a client made by openapi-python-client: api, client and models."""
    folder = tmp_path_factory.mktemp("generated")
    done = subprocess.run(
        [
            *(sys.executable, "-m", "openapi_python_client", "generate", "--meta", "none"),
            *("--path", DOCUMENT, "--output-path", folder / "optodrive_api"),
        ],
        capture_output=True,
        text=True,
        env={**os.environ, "PATH": f"{sys.prefix}/bin:{os.environ['PATH']}"},  # it formats with ruff
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "arning" not in done.stdout, done.stdout  # about a part of the document that it leaves out
    sys.path.insert(0, str(folder))
    yield lambda name: importlib.import_module(f"optodrive_api.{name}")
    sys.path.remove(str(folder))


def test_a_generated_python_client_plays_and_reads(generated, embedded):
    models, http = generated("models"), httpx.Timeout(60)
    client = generated("client").AuthenticatedClient(embedded.url, token=TOKEN, timeout=http)
    with client as api:
        assert generated("api.board.arm").sync(client=api).board.state == models.BoardState.ARMED
        heights = models.HeightByPixel.from_dict({"3": 50.0})
        body = models.FrameSequence(
            frames=[models.HeightFrame(show_at_s=0.0, duration_s=0.5, target_um=heights, id="three")],
            trains=[models.HeightTrain(pixel=4, start_s=0.6, duration_s=0.2, period_s=0.05, target_um=60.0)],
            labels=models.Labels.from_dict({"trial": 7}),
        )
        pushed = generated("api.plans.submit_plan").sync(client=api, body=body, name="generated")
        trim = models.PlayPatternPolicy.TRIM
        played = generated("api.patterns.play_pattern").sync("dot", client=api, policy=trim)
        get_plan = generated("api.plans.get_plan").sync
        ended = models.PlanStatus.DONE, models.PlanStatus.FAILED, models.PlanStatus.STOPPED
        for plan in (pushed, played):
            report = wait_for(
                lambda plan=plan: (found := get_plan(plan.plan, client=api)).status in ended and found, "its end", 0.02
            )
            assert report.status == models.PlanStatus.DONE
        state = generated("api.state.get_state").sync(client=api)
        refused = get_plan("none", client=api)
    assert state.totals.executed == state.totals.planned > 5
    assert pushed.labels.to_dict() == {"trial": 7}
    assert (type(refused), refused.code) == (models.Problem, "plan_not_found")


@pytest.mark.slow
def test_a_generated_typescript_client_plays_and_reads(embedded, tmp_path):
    """Compiled with strict types, then run by Node."""
    assert (NODE_MODULES / "openapi-typescript").exists(), "scripts/test-packages installs it"
    (tmp_path / "node_modules").symlink_to(NODE_MODULES)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "client.ts").write_text(TYPESCRIPT)
    strict = ["--strict", "--target", "es2022", "--module", "nodenext", "--lib", "es2022,dom,dom.iterable"]
    for command in (
        ["openapi-typescript/bin/cli.js", DOCUMENT, "-o", "optodrive.d.ts"],
        ["typescript/bin/tsc", *strict, "client.ts"],
    ):
        node = [shutil.which("node"), tmp_path / "node_modules" / command[0], *command[1:]]
        done = subprocess.run(node, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    wait_for(lambda: embedded.board_state() == "DISARMED", "the link to the board")
    run = [shutil.which("node"), "client.js", embedded.url, TOKEN]
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    answer = json.loads(done.stdout)
    assert answer.pop("executed") > 5
    assert answer == {"statuses": ["done", "done"], "state": "ARMED", "refused": "plan_not_found"}
