"""The client in JavaScript in Chromium, on a page of the daemon's own origin."""

from pathlib import Path

import pytest

from rig import TOKEN

CLIENT = Path(__file__).parents[2] / "docs/examples/optodrive.js"
SCENE = """async ([source, url, token]) => {
  const address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
  const { DisplayStream, Hold, stop } = await import(address);
  const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  const hold = new Hold({ url, token });
  await hold.armed;
  const stream = new DisplayStream({ url, token });
  const results = [];
  stream.onresult = (result) => results.push(result);
  await stream.ready;
  for (let sent = 0; sent < 45; sent += 1) {
    stream.send({ 17: 60 });
    await pause(11);
  }
  while (!results.some((each) => each.frame === 44 && each.status !== "planned")) await pause(5);
  const state = await stop({ url, token });
  stream.close();
  return { counts: stream.counts, board: state.board.state };
}"""


@pytest.mark.slow
def test_a_page_arms_streams_and_stops(browser, bench):
    context = browser.new_context(bypass_csp=True)  # the module stands in no file of the daemon
    try:
        page = context.new_page()
        page.goto(bench.daemon.url)
        result = page.evaluate(SCENE, [CLIENT.read_text(), bench.daemon.url, TOKEN])
    finally:
        context.close()
    counts = result["counts"]
    assert counts["sent"] == 45 == counts["shown"] + counts["superseded"]
    assert counts["shown"] > 0
    assert result["board"] == "DISARMED"
