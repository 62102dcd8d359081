// Puts the page together: what comes from the telemetry goes to the views, what is asked for goes to the daemon.

import { Arm } from "./arm.js";
import { call } from "./api.js";
import { table } from "./colours.js";
import { DisplayView } from "./display.js";
import { Drawing } from "./draw.js";
import { Gauges } from "./gauges.js";
import { Grid, numbers } from "./grid.js";
import { Library } from "./patterns.js";
import { framesOf, Plans, setCaps } from "./plans.js";
import { Status } from "./status.js";
import { Stop } from "./stop.js";
import { Telemetry } from "./telemetry.js";
import { themeButton } from "./theme.js";
import { Timeline } from "./timeline.js";
import { Trace } from "./trace.js";

const find = (id) => document.getElementById(id);
const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
const telemetry = new Telemetry(calm ? 5 : 30);
const say = (text) => (find("said").textContent = text);

// First of all STOP, which needs nothing that comes after.
let plans = null;
new Stop(
  find("stop"),
  find("stopping"),
  () => {
    plans?.cancel();
    telemetry.pause(true);
  },
  () => telemetry.pause(document.hidden),
);
if (location.hash) {
  history.replaceState(null, "", location.pathname);
}

async function loaded(path) {
  for (;;) {
    try {
      return await call("GET", path);
    } catch (error) {
      find("summary").textContent = `${error.message} Trying again …`;
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
  }
}

const [config, { patterns }] = [await loaded("/v1/config"), await loaded("/v1/patterns")];
setCaps(config.limits.caps);
const grid = new Grid(config);
const view = new DisplayView(find("display"), grid);
view.ambient = config.ambient_c;
const drawing = new Drawing(view);
const timeline = new Timeline(find("timeline"), find("timeline-text"), config.laser.max_power_w);
const trace = new Trace(find("trace"));
const gauges = new Gauges(find("gauges"));
const failed = (error) => {
  find("arming").textContent = error.message;
  say(error.message);
};
const arm = new Arm(find, say, failed);
const status = new Status(find, say, () => arm.disarm());
const library = new Library(find, patterns, () => view.cursor);
find("display-name").textContent = `${config.name}, ${grid.pixels} pixels`;
document.title = `${config.name} · optodrive`;

// --- what is asked for ----------------------------------------------------------------------------------------------

const chosen = (name) => document.querySelector(`input[name="${name}"]:checked`).value;
const number = (id) => Number(find(id).value) || 0;

async function asked() {
  if (chosen("source") === "library") {
    return { path: `/v1/patterns/${encodeURIComponent(library.name)}`, body: await library.values() };
  }
  if (!drawing.count) {
    throw new Error("Nothing is drawn yet: raise pixels on the display, or lay a picture on it.");
  }
  return { path: "/v1/plans", body: framesOf(drawing.heights, number("rate"), number("seconds") || 1) };
}

plans = new Plans(find, asked, say);
const changed = () => {
  plans.changed();
  find("drawn").textContent = drawing.count ? `${drawing.count} drawn` : "nothing drawn";
  pickedText();
};

plans.addEventListener("previewed", ({ detail: pulses }) => {
  const predicted = new Float32Array(grid.pixels);
  pulses?.pixel.forEach((pixel, k) => (predicted[pixel] = Math.max(predicted[pixel], pulses.predicted_um[k])));
  view.values.preview = predicted;
  if (pulses) {
    show("preview");
  } else if (view.show === "preview") {
    show("height");
  }
});
drawing.addEventListener("changed", changed);
library.addEventListener("changed", changed);
drawing.addEventListener("picked", () => {
  trace.forget();
  pickedText();
  say(find("picked").textContent);
});
find("clear").addEventListener("click", () => drawing.clear());
find("height").addEventListener("input", () => drawing.rescale(number("height")));
for (const id of ["rate", "seconds"]) {
  find(id).addEventListener("input", changed);
}
const lay = () =>
  find("picture").files[0] &&
  drawing.lay(find("picture").files[0], find("invert").checked).catch(() => say("This file is no picture that the browser can read."));
find("picture").addEventListener("change", lay);
find("invert").addEventListener("change", lay);
for (const radio of document.querySelectorAll('input[name="tool"]')) {
  radio.addEventListener("change", () => (drawing.tool = chosen("tool")));
}
for (const radio of document.querySelectorAll('input[name="source"]')) {
  radio.addEventListener("change", () => {
    drawing.editing = chosen("source") === "draw";
    view.canvas.toggleAttribute("data-editing", drawing.editing);
    find("draw").hidden = !drawing.editing;
    find("library").hidden = drawing.editing;
    changed();
  });
}

// --- what is shown --------------------------------------------------------------------------------------------------

function show(what) {
  view.show = what;
  document.querySelector(`input[name="show"][value="${what}"]`).checked = true;
  view.ask();
  legend();
}

function legend() {
  const unit = view.show === "absorber" ? "°C" : "µm";
  find("legend-low").textContent = `${Math.round(view.low)} ${unit}`;
  find("legend-high").textContent = `${Math.round(view.low + view.top[view.show])} ${unit}`;
}

function colours() {
  const bytes = table(find("colours").value);
  find("legend").getContext("2d").putImageData(new ImageData(Uint8ClampedArray.from({ length: 256 * 48 }, (_, k) => bytes[k % 1024]), 256, 12), 0, 0);
  view.setColours(find("colours").value);
}

function pickedText() {
  const pixel = view.cursor;
  const [height, celsius] = [view.values.height[pixel], view.values.absorber[pixel]];
  const drawn = view.drawn[pixel] > 0 ? `, drawn ${view.drawn[pixel].toFixed(0)} µm` : "";
  const predicted = view.values.preview[pixel] > 0 ? `, predicted ${view.values.preview[pixel].toFixed(1)} µm` : "";
  find("picked").textContent = `Pixel ${pixel}: ${height.toFixed(1)} µm, ${celsius.toFixed(1)} °C${drawn}${predicted}`;
}

function summary() {
  const { height, absorber } = view.values;
  const most = (values) => values.reduce((best, value, pixel) => (value > values[best] ? pixel : best), 0);
  const [high, hot] = [most(height), most(absorber)];
  const raised = height.reduce((sum, value) => sum + (value > 1), 0);
  const text = raised
    ? `${raised} pixels above 1 µm, highest ${height[high].toFixed(1)} µm at ${high}; hottest absorber ${absorber[hot].toFixed(0)} °C at ${hot}.`
    : "Nothing is raised; all is at rest.";
  find("summary").textContent = `${text} ${view.rate ? `${view.rate} frames/s.` : ""}`;
}

for (const radio of document.querySelectorAll('input[name="show"]')) {
  radio.addEventListener("change", () => show(chosen("show")));
}
find("colours").addEventListener("change", colours);
themeButton(find("theme"), () => {
  view.themed();
  timeline.themed();
  trace.themed();
});
view.rescaled = legend;
legend();
find("beam").checked = !calm;
colours();
changed();
view.canvas.toggleAttribute("data-editing", true);

telemetry.addEventListener("up", () => {
  status.connection(true);
  timeline.forget();
});
telemetry.addEventListener("down", () => {
  status.connection(false);
  find("stale").hidden = false;
  arm.show("");
});
telemetry.addEventListener("stranger", () => status.stranger());
telemetry.addEventListener("state", ({ detail }) => {
  if (detail.display !== config.name || detail.pixels !== grid.pixels) {
    location.reload(); // a daemon with another display was started here
  }
  status.showState(detail);
  arm.show(detail.link.state === "up" ? detail.board.state : "");
});
telemetry.addEventListener("fault", ({ detail }) => status.showFault(detail));
telemetry.addEventListener("budget", ({ detail }) => gauges.show(detail.caps));
telemetry.addEventListener("pulses", ({ detail }) => timeline.take(detail));
telemetry.addEventListener("display", ({ detail }) => {
  find("stale").hidden = true;
  const tenths = (values) => Float32Array.from(values, (value) => value / 10);
  const [height, absorber] = [tenths(numbers(detail.height)), tenths(numbers(detail.absorber))];
  view.beam = find("beam").checked ? timeline.path() : [];
  view.take(height, absorber);
  trace.add(detail.board_s, height[view.cursor], absorber[view.cursor]);
});
telemetry.run();

// Words and slower pictures: a few times a second are enough.
let counted = { frames: 0, at: performance.now() };
let ticks = 0;
setInterval(() => {
  if (++ticks % 2 === 0) {
    timeline.paint();
  } else {
    pickedText();
    trace.paint();
  }
  if (ticks % 10 === 0) {
    const now = performance.now();
    view.rate = Math.round(((view.frames - counted.frames) * 1000) / (now - counted.at));
    counted = { frames: view.frames, at: now };
    summary();
    timeline.describe();
  }
}, calm ? 500 : 100);
