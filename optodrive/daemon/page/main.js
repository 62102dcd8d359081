// The page: telemetry goes to the views, controls send requests to the daemon.

import { Announcer } from "./announcer.js";
import { ArmControl } from "./arm.js";
import { call } from "./api.js";
import { LEASED_STATES } from "./board_states.js";
import { setCapLabels } from "./caps.js";
import { buildColourMap } from "./colours.js";
import { DimControl } from "./dim.js";
import { DisplayView } from "./display.js";
import { Drawing } from "./draw.js";
import { FingersView } from "./fingers.js";
import { Freshness } from "./freshness.js";
import { Gauges } from "./gauges.js";
import { decodeUint16, Grid } from "./grid.js";
import { Header } from "./header.js";
import { History } from "./history.js";
import { HoldControl } from "./hold.js";
import { PatternLibrary } from "./patterns.js";
import { PauseControl } from "./pause.js";
import { Permissions } from "./permissions.js";
import { buildFrames, PlanControl, TARGETS } from "./plans.js";
import { QueueView } from "./queue.js";
import { Status } from "./status.js";
import { StopControl } from "./stop.js";
import { Telemetry } from "./telemetry.js";
import { bindThemeButton } from "./theme.js";
import { Timeline } from "./timeline.js";
import { Trace } from "./trace.js";

const find = (id) => document.getElementById(id);
const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)").matches;
const telemetry = new Telemetry(reducedMotion ? 5 : 30);
const announcer = new Announcer(find("said"));
const announce = (text) => announcer.say(text);

// STOP first: it depends on nothing that follows.
let plans = null;
let mayEmit = () => true;
new StopControl(
  find("stop"),
  find("stopping"),
  () => {
    plans?.cancel();
    telemetry.pause(true);
  },
  () => telemetry.pause(document.hidden),
  () => mayEmit(),
  new Announcer(find("said-at-once")),
);
if (location.hash) {
  history.replaceState(null, "", location.pathname);
}

async function loadWithRetry(path) {
  for (;;) {
    try {
      return await call("GET", path);
    } catch (error) {
      find("summary").textContent = `${error.message} Trying again …`;
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
  }
}

const [config, { patterns }] = [await loadWithRetry("/v1/config"), await loadWithRetry("/v1/patterns")];
setCapLabels(config.limits.caps);
const grid = new Grid(config);
const view = new DisplayView(find("display"), grid);
view.ambient = config.ambient_c;
view.maxC = config.limits.absorber_max_c;
const drawing = new Drawing(view);
const fingersView = new FingersView(find, view, config.display.pitch_m, announce);
const timeline = new Timeline(find("timeline"), find("timeline-text"), config.laser.max_power_w);
const trace = new Trace(find("trace"));
const gauges = new Gauges(find("gauges"));
const showError = (error) => {
  find("arming").textContent = error.message;
  announce(error.message);
};
const arm = new ArmControl(find, announce, showError);
const hold = new HoldControl(find, announce, () => plans.playPreviewed());
const pause = new PauseControl(find, announce, showError);
const header = new Header(find, announce);
const permissions = new Permissions(find);
const dim = new DimControl(find, config.limits.power_share, () => permissions.caller, announce, showError);
const status = new Status(find, () => arm.disarm(), () => permissions.apply());
const panelOf = (id) => find(id).closest(".panel");
const freshness = new Freshness(
  {
    state: [panelOf("now")],
    board: [panelOf("figures")],
    budget: [panelOf("gauges")],
    display: [panelOf("display"), panelOf("timeline"), panelOf("trace")],
    fingers: [panelOf("fingers")],
  },
  (source) => {
    if (source === "state") {
      showNothingKnown("no data from the daemon");
    } else if (source === "fingers") {
      fingersView.clear();
    }
  },
);
const pastEvents = new History(find);
const queue = new QueueView(find, announce, showError);
const library = new PatternLibrary(find, patterns, () => view.cursor);
find("display-name").textContent = `${config.name}, ${grid.pixels} px`;

// --- controls -------------------------------------------------------------------------------------------------------

const readChoice = (name) => document.querySelector(`input[name="${name}"]:checked`).value;
const readTarget = () => (find("by-intensity").checked ? "intensity" : "target_um");
const readNumber = (id) => Number(find(id).value) || 0;

async function buildRequest() {
  if (readChoice("source") === "library") {
    return { path: `/v1/patterns/${encodeURIComponent(library.name)}`, body: await library.readValues() };
  }
  if (!drawing.count) {
    throw new Error("Nothing is drawn yet: raise pixels on the display, or place a picture on it.");
  }
  return { path: "/v1/plans", query: { name: "drawing" }, body: buildFrames(readTarget(), drawing.heights, readNumber("rate"), readNumber("seconds") || 1) };
}

plans = new PlanControl(find, buildRequest, announce);
const onStimulusChange = () => {
  plans.invalidate();
  find("drawn").textContent = drawing.count ? `${drawing.count} drawn` : "nothing drawn";
  describeSelected();
};

plans.addEventListener("previewed", ({ detail: pulses }) => {
  const predicted = new Float32Array(grid.pixels);
  pulses?.pixel.forEach((pixel, k) => (predicted[pixel] = Math.max(predicted[pixel], pulses.predicted_um[k])));
  view.values.preview = predicted;
  if (pulses) {
    showQuantity("preview");
  } else if (view.quantity === "preview") {
    showQuantity("height");
  }
});
plans.addEventListener("played", () => showQuantity("height")); // what is predicted must not look as if it were felt
drawing.addEventListener("changed", onStimulusChange);
library.addEventListener("changed", onStimulusChange);
drawing.addEventListener("selected", () => {
  trace.clear();
  describeSelected();
  announce(`${find("picked").textContent}, ${grid.describePlace(view.cursor)}`);
});
find("clear").addEventListener("click", () => drawing.clear());
find("height").addEventListener("input", () => drawing.rescale(readNumber("height")));
find("by-intensity").addEventListener("change", () => {
  const { label, value, min, max } = TARGETS[readTarget()];
  find("height-label").textContent = label;
  Object.assign(find("height"), { value, min, max });
  drawing.rescale(value);
  onStimulusChange();
});
for (const id of ["rate", "seconds"]) {
  find(id).addEventListener("input", onStimulusChange);
}
const placePicture = () =>
  find("picture").files[0] &&
  drawing.placePicture(find("picture").files[0], find("invert").checked).catch(() => announce("The browser cannot read this file as a picture."));
find("picture").addEventListener("change", placePicture);
find("invert").addEventListener("change", placePicture);
for (const radio of document.querySelectorAll('input[name="tool"]')) {
  radio.addEventListener("change", () => (drawing.tool = readChoice("tool")));
}
for (const radio of document.querySelectorAll('input[name="source"]')) {
  radio.addEventListener("change", () => {
    drawing.editing = readChoice("source") === "draw";
    view.canvas.toggleAttribute("data-editing", drawing.editing);
    find("draw").hidden = !drawing.editing;
    find("library").hidden = drawing.editing;
    onStimulusChange();
  });
}

// --- views ----------------------------------------------------------------------------------------------------------

function showQuantity(quantity) {
  view.quantity = quantity;
  document.querySelector(`input[name="show"][value="${quantity}"]`).checked = true;
  view.requestPaint();
  updateLegend();
}

function applyScale() {
  view.maxUm = Number(readChoice("scale"));
  view.requestPaint();
  updateLegend();
}

function updateLegend() {
  const unit = view.quantity === "absorber" ? "°C" : "µm";
  find("legend-low").textContent = `${Math.round(view.scaleMin)} ${unit}`;
  find("legend-high").textContent = `≥ ${Math.round(view.scaleMax)} ${unit}`;
}

function applyColourMap() {
  const name = readChoice("colours");
  const bytes = buildColourMap(name);
  const pixels = Uint8ClampedArray.from({ length: 256 * 48 }, (_, k) => bytes[k % 1024]);
  find("legend").getContext("2d").putImageData(new ImageData(pixels, 256, 12), 0, 0);
  view.setColourMap(name);
}

function describeSelected() {
  const pixel = view.cursor;
  const [height, absorber] = [view.values.height[pixel], view.values.absorber[pixel]];
  const target = TARGETS[readTarget()];
  const drawn = view.drawn[pixel] > 0 ? `, drawn ${Number(view.drawn[pixel].toFixed(target.decimals))}${target.unit}` : "";
  const predicted = view.values.preview[pixel] > 0 ? `, predicted ${view.values.preview[pixel].toFixed(1)} µm` : "";
  const peak = trace.peakUm > 0 ? `, peak ${trace.peakUm.toFixed(1)} µm` : "";
  find("picked").textContent = `Pixel ${pixel}: ${height.toFixed(1)} µm${peak}, ${absorber.toFixed(1)} °C${drawn}${predicted}`;
}

function describeDisplay() {
  const { height, absorber } = view.values;
  const argmax = (values) => values.reduce((best, value, pixel) => (value > values[best] ? pixel : best), 0);
  const [highest, hottest] = [argmax(height), argmax(absorber)];
  const raised = height.reduce((sum, value) => sum + (value > 1), 0);
  const text = raised
    ? `${raised} ${raised === 1 ? "pixel" : "pixels"} above 1 µm, highest ${height[highest].toFixed(1)} µm at ${highest}; hottest absorber ${absorber[hottest].toFixed(0)} °C at ${hottest}.`
    : "No pixel is above 1 µm.";
  find("summary").textContent = text;
  find("frame-rate").textContent = `${view.rate} frames/s`;
}

for (const radio of document.querySelectorAll('input[name="show"]')) {
  radio.addEventListener("change", () => showQuantity(readChoice("show")));
}
for (const radio of document.querySelectorAll('input[name="colours"]')) {
  radio.addEventListener("change", applyColourMap);
}
bindThemeButton(find("theme"), () => {
  view.applyTheme();
  timeline.applyTheme();
  trace.applyTheme();
});
for (const radio of document.querySelectorAll('input[name="scale"]')) {
  radio.checked = radio.value === (localStorage.getItem("scale") ?? "200");
  radio.addEventListener("change", () => {
    localStorage.setItem("scale", radio.value);
    applyScale();
  });
}
applyScale();
find("beam").checked = !reducedMotion;
applyColourMap();
onStimulusChange();
view.canvas.toggleAttribute("data-editing", true);

let isOff = false;
let hasLink = false;
mayEmit = () => !(telemetry.live && isOff);
const showTitle = () => (document.title = `${header.state} · ${config.name} · optodrive`);
showTitle();

// The state is old: nothing on the page claims that the laser runs, or that it does not.
function showNothingKnown(reason) {
  isOff = false;
  header.showUnknown(reason);
  queue.clear(`Unknown: ${reason}.`);
  arm.show("");
  hold.show("");
  pause.show("", null);
  arm.showControl(null);
  dim.show(null);
  showTitle();
}

function showInvalidToken() {
  header.showConnection("no access", "bad");
  showNothingKnown("no access to the daemon");
  status.showInvalidToken(telemetry.revocation);
  permissions.refuse();
}

telemetry.addEventListener("up", () => {
  permissions.load();
  timeline.clear();
});
telemetry.addEventListener("down", () => {
  freshness.lose();
  fingersView.clear();
  if (telemetry.revocation) {
    showInvalidToken();
  } else if (telemetry.paused) {
    header.showConnection("paused", "bad");
    showNothingKnown("telemetry is paused");
  } else {
    header.showConnection("no daemon, trying again", "bad");
    showNothingKnown("no daemon");
    status.showNoDaemon();
    pastEvents.addNoDaemon();
  }
  find("stale").hidden = false;
});
telemetry.addEventListener("unauthorized", showInvalidToken);
telemetry.addEventListener("state", ({ detail }) => {
  const isLinked = detail.link.state === "up";
  isOff = isLinked && !LEASED_STATES.includes(detail.board.state);
  if (detail.display !== config.name || detail.pixels !== grid.pixels) {
    location.reload(); // the restarted daemon has another display
  }
  header.showConnection("live", "good");
  header.showState(detail);
  if (isOff) {
    timeline.dropPlanned();
  }
  showTitle();
  status.showState(detail);
  queue.show(detail.queue);
  pastEvents.showPlans(detail);
  arm.show(isLinked ? detail.board.state : "");
  dim.show(detail.limits.power_share);
  hold.show(isLinked ? detail.board.state : "");
  pause.show(isLinked ? detail.board.state : "", detail.queue);
  arm.showControl(isLinked ? detail.control : null, permissions.caller?.name);
  hasLink = isLinked;
  freshness.see("state");
  if (isLinked) {
    freshness.see("board");
  }
});
telemetry.addEventListener("fault", ({ detail }) => {
  status.showFault(detail);
  pastEvents.addFault(detail);
});
telemetry.addEventListener("budget", ({ detail }) => {
  gauges.show(detail.caps);
  find("panel").textContent = `Panel: up to ${detail.panel_c.toFixed(1)} °C.`;
  if (hasLink) {
    freshness.see("budget"); // without a link nobody knows what the board executes
  }
});
telemetry.addEventListener("fingers", ({ detail }) => {
  fingersView.showFingers(detail);
  freshness.see("fingers");
});
telemetry.addEventListener("page", ({ detail }) => fingersView.showPage(detail));
telemetry.addEventListener("pulses", ({ detail }) => timeline.addPulses(detail));
telemetry.addEventListener("display", ({ detail }) => {
  find("stale").hidden = true;
  freshness.see("display");
  const fromTenths = (values) => Float32Array.from(values, (value) => value / 10);
  const read = (column) => fromTenths(decodeUint16(column));
  const [height, absorber] = [read(detail.height), read(detail.absorber)];
  view.beamPath = find("beam").checked ? timeline.beamPath() : [];
  view.setValues(height, absorber);
  trace.add(detail.board_s, read(detail.height_peak)[view.cursor], read(detail.absorber_peak)[view.cursor]);
});
telemetry.run();

// Charts are updated a few times per second, texts once.
const updateMs = reducedMotion ? 500 : 100;
let lastCount = { frames: 0, at: performance.now() };
let updates = 0;
setInterval(() => {
  if (++updates % 2 === 0) {
    timeline.paint();
  } else {
    describeSelected();
    trace.paint();
  }
  if (updates % (1000 / updateMs) === 0) {
    const now = performance.now();
    view.rate = Math.round(((view.frames - lastCount.frames) * 1000) / (now - lastCount.at));
    lastCount = { frames: view.frames, at: now };
    describeDisplay();
    timeline.describe();
  }
}, updateMs);
