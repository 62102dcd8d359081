// The page: telemetry goes to the views, controls send requests to the daemon.

import { Announcer, Reports } from "./announcer.js";
import { ArmControl } from "./arm.js";
import { call } from "./api.js";
import { BoardState, LEASED_STATES } from "./board_states.js";
import { setCapLabels } from "./caps.js";
import { buildColourMap } from "./colours.js";
import { DimControl } from "./dim.js";
import { DisplayView } from "./display.js";
import { Drawing } from "./draw.js";
import { FingersView } from "./fingers.js";
import { Freshness } from "./freshness.js";
import { Gauges } from "./gauges.js";
import { decodeUint16, Grid } from "./grid.js";
import { describeUnknown, Header } from "./header.js";
import { History } from "./history.js";
import { HoldControl } from "./hold.js";
import { PatternLibrary } from "./patterns.js";
import { PauseControl } from "./pause.js";
import { Permissions } from "./permissions.js";
import { buildFrames, PlanControl, TARGETS } from "./plans.js";
import { QueueView } from "./queue.js";
import { hasPlanner, Status } from "./status.js";
import { StopControl } from "./stop.js";
import { Telemetry } from "./telemetry.js";
import { bindThemeButton } from "./theme.js";
import { Timeline } from "./timeline.js";
import { Peaks, Trace } from "./trace.js";

const find = (id) => document.getElementById(id);
const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)").matches;
const telemetry = new Telemetry(reducedMotion ? 5 : 30);
const announcer = new Announcer(find("said"));
const announce = (text) => announcer.say(text); // the answer to what was pressed
const reports = new Reports(new Announcer(find("said-at-once")), announcer);

let isOff = false;
let isKnown = false; // whether the board reports its state
let mayPlay = false; // whether planned pulses start

// STOP first: it depends on nothing that follows.
let plans = null;
let mayEmit = () => true;
const stopControl = new StopControl(
  find("stop"),
  find("stopping"),
  () => {
    plans?.cancel();
    telemetry.pause(true);
  },
  () => telemetry.pause(document.hidden),
  () => mayEmit(),
  (text) => reports.report("stop", text, true),
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
const fingersView = new FingersView(find, view, config.display.pitch_m, (text) => reports.report("tracker", text));
const timeline = new Timeline(find("timeline"), find("timeline-text"), config.laser.max_power_w);
const trace = new Trace(find("trace"));
const peaks = new Peaks(grid.pixels);
const gauges = new Gauges(find("gauges"));
const showError = (error) => {
  find("arming").textContent = error.message;
  announce(error.message);
};
const arm = new ArmControl(find, announce, showError);
const hold = new HoldControl(find, announce, () => plans.playPreviewed());
const pause = new PauseControl(find, announce, showError);
const header = new Header(find, (topic, text) => reports.report(topic, text));
const permissions = new Permissions(find);
const dim = new DimControl(find, config.limits.power_share, () => permissions.caller, announce, showError);
const status = new Status(
  find,
  () => arm.disarm(),
  () => permissions.apply(),
  (text) => reports.report("trouble", text, true),
);
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

plans = new PlanControl(find, buildRequest, announce, (text) => reports.report("plan", text));
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
  trace.add(timeline.nowS(), ...peaks.of(view.cursor));
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
  const [peakUm, peakC] = trace.peaks ?? [height, absorber];
  const now = `now ${height.toFixed(1)} µm, ${absorber.toFixed(1)} °C`;
  const values = isKnown ? `${now}; peak ${peakUm.toFixed(1)} µm, ${peakC.toFixed(1)} °C in 10 s` : "unknown";
  find("picked").textContent = `Pixel ${pixel}: ${values}${drawn}${predicted}`;
}

function describeDisplay() {
  const { height, absorber } = peaks.take();
  const argmax = (values) => values.reduce((best, value, pixel) => (value > values[best] ? pixel : best), 0);
  const [highest, hottest] = [argmax(height), argmax(absorber)];
  const raised = height.reduce((sum, value) => sum + (value > 1), 0);
  const text = raised
    ? `${raised} ${raised === 1 ? "pixel" : "pixels"} above 1 µm, highest ${height[highest].toFixed(1)} µm at ${highest}; hottest absorber ${absorber[hottest].toFixed(1)} °C at ${hottest}: peaks of the last second.`
    : "No pixel was above 1 µm in the last second.";
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

const describePulses = () => timeline.describe(mayPlay);
mayEmit = () => !(telemetry.live && isOff);
const showTitle = () => (document.title = `${header.state} · ${config.name} · optodrive`);
showTitle();

// What the board executes is not known: no figure of now is shown.
function showNoValues(reason) {
  find("summary").textContent = find("timeline-text").textContent = `Unknown: ${reason}.`;
  find("stale").hidden = false;
  describeSelected();
}

// The state is old: nothing on the page claims that the laser runs, or that it does not.
function showNothingKnown(reason) {
  isOff = isKnown = mayPlay = false;
  plans.showQueue(null);
  showNoValues(reason);
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
  pastEvents.begin();
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
  const { board, link, queue: plansOfDaemon } = detail;
  isKnown = link.state === "up" && board.state in BoardState;
  isOff = isKnown && !LEASED_STATES.includes(board.state);
  mayPlay = isKnown && !isOff && !plansOfDaemon.paused;
  if (detail.display !== config.name || detail.pixels !== grid.pixels) {
    location.reload(); // the restarted daemon has another display
  }
  header.showConnection("live", "good");
  header.showState(detail);
  if (!isKnown || isOff) {
    timeline.dropPlanned();
  }
  showTitle();
  status.showState(detail, isKnown);
  showPlans(detail);
  const state = isKnown ? board.state : "";
  arm.show(state, plansOfDaemon.paused);
  hold.show(state);
  pause.show(state, plansOfDaemon);
  dim.show(detail.limits.power_share);
  arm.showControl(isKnown ? detail.control : null, permissions.caller?.name);
  freshness.see("state");
  if (isKnown) {
    stopControl.noteLink();
    freshness.see("board");
    describePulses();
  } else {
    freshness.lose(["board", "budget", "display"]);
    showNoValues(describeUnknown(link));
  }
});

function showPlans(state) {
  const { board, link } = state;
  if (!isKnown || !hasPlanner(state)) {
    queue.clear(`Unknown: ${isKnown ? "the planner is restarted" : describeUnknown(link)}.`);
    plans.showQueue(null);
    return;
  }
  const light = isOff ? "off" : [BoardState.RUNNING, BoardState.HOLD].includes(board.state) ? "emits" : "may";
  queue.show(state.queue, light);
  plans.showQueue(state.queue);
  pastEvents.showPlans(state);
}

telemetry.addEventListener("fault", ({ detail }) => {
  status.showFault(detail);
  pastEvents.addFault(detail);
});
telemetry.addEventListener("budget", ({ detail }) => {
  gauges.show(detail.caps);
  find("panel").textContent = `Panel: up to ${detail.panel_c.toFixed(1)} °C.`;
  timeline.setTime(detail.board_s);
  if (isKnown) {
    freshness.see("budget");
  }
});
telemetry.addEventListener("fingers", ({ detail }) => {
  fingersView.showFingers(detail);
  freshness.see("fingers");
});
telemetry.addEventListener("page", ({ detail }) => fingersView.showPage(detail));
telemetry.addEventListener("pulses", ({ detail }) => {
  const wasEmpty = timeline.beamPath(4).length === 0; // with the first pulse the text is wrong
  timeline.addPulses(detail);
  if (isKnown && wasEmpty) {
    describePulses();
  }
});
telemetry.addEventListener("display", ({ detail }) => {
  timeline.setTime(detail.board_s);
  find("stale").hidden = isKnown;
  if (isKnown) {
    freshness.see("display");
  }
  const fromTenths = (values) => Float32Array.from(values, (value) => value / 10);
  const read = (column) => fromTenths(decodeUint16(column));
  const [height, absorber] = [read(detail.height), read(detail.absorber)];
  view.beamPath = find("beam").checked ? timeline.beamPath() : [];
  view.setValues(height, absorber);
  peaks.add(read(detail.height_peak), read(detail.absorber_peak));
  if (!isKnown) {
    peaks.take(); // they are not of the second in which the board reports again
  }
  trace.add(detail.board_s, ...peaks.newestOf(view.cursor));
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
    if (isKnown && !freshness.isStale("display")) {
      describeDisplay();
      describePulses();
    }
  }
}, updateMs);
