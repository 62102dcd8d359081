// States, jobs and points of a board, written from PROTOCOL.md alone: "States", "Arming", "Jobs and points", B1 to B12, B17.
//
// Every event is carried out at its own microsecond: run() takes what is due in order of time, and within one tick in the
// order lease, arming, hold, points.

import { randomBytes } from "node:crypto";

import { Accounts } from "./accounts.mjs";
import { LIMIT_NAMES } from "./wire.mjs";

const INDICATOR_US = 2_000_000;
const ARMING_US = 10_000_000;
const HOLD_US = 1_000_000;
const UNDERRUNS_MAX = 3;
const UNDERRUN_WINDOW_US = 10_000_000;
const NUMBERS = 2 ** 32;
const CENTRE = 32768;
const LEASED = ["ARMING", "ARMED", "RUNNING", "HOLD"];
const QUEUEING = ["ARMED", "RUNNING", "HOLD"];
const LESS_IS_TIGHTER = [
  "max_on_us", "max_duty", "mean_duty", "spot_uj", "spot_leak_uw", "x_max", "y_max", "lease_ms",
];
const UNSAFE = { interlock: false, key: false, estop: true };
const CONSUMED = "";

/** The board's activity. hooks: log(entry), send(name, values), setGate(on), move(x, y), readMirrors(),
 * record(index, tick, on_us, duty) */
export class Machine {
  constructor(settings, hooks, inputs, now) {
    this.settings = settings;
    this.own = Object.fromEntries(LIMIT_NAMES.map((name) => [name, settings[name]]));
    this.limits = { ...this.own };
    this.hooks = hooks;
    this.inputs = { ...inputs };
    this.accounts = new Accounts(settings);
    this.bootUs = this.now = now;
    this.state = "BOOT";
    this.fault = "";
    this.isVersionKnown = false;
    this.keyTurned = false;
    this.leaseUntil = 0;
    this.arming = null;
    this.queue = [];
    this.nextNumber = this.doneIndex = 0;
    this.job = this.current = null;
    this.holdSince = 0;
    this.underruns = 0;
    this.underrunTimes = [];
    this.position = { x: CENTRE, y: CENTRE };
    this.measured = { x: 0, y: 0 };
    this.follows = !settings.feedback_codes;
    this.settledAt = now + (this.follows ? 0 : this.settlingUs(CENTRE));
    this.isGateOn = false;
    this.laserOnTimesDuty = 0;
    this.triggers = { count: 0, tick: 0 };
  }

  boot() {
    this.change("DISARMED", "boot");
  }

  get tick() {
    return this.now - this.bootUs;
  }

  // --- states ---------------------------------------------------------------------------------------------------------

  change(state, reason) {
    this.closeGate(reason);
    const before = this.state;
    this.state = state;
    if (state === "DISARMED" || state === "FAULT") this.drop();
    if (state !== "ARMING") this.arming = null;
    this.hooks.log({ event: "state", state, before, reason });
    this.hooks.send("EVENT", { state, fault: this.fault, reason, tick: this.tick });
  }

  fail(fault) {
    if (this.state === "FAULT") return;
    this.closeGate("fault");
    this.fault = fault;
    this.hooks.log({ event: "fault", fault });
    this.change("FAULT", "fault");
  }

  /** Drop queue and job; what was queued counts as done. */
  drop() {
    this.queue = [];
    this.job = this.current = null;
    this.doneIndex = this.nextNumber;
  }

  /** End the present activity for a reason: ABORT, HELLO, DISARM or a lost link. */
  end(reason) {
    if (LEASED.includes(this.state)) this.change("DISARMED", reason);
    else this.drop();
  }

  beginSession(isVersionKnown) {
    this.end("hello");
    this.nextNumber = this.doneIndex = 0;
    this.limits = { ...this.own };
    this.isVersionKnown = isVersionKnown;
  }

  setInput(name, value) {
    if (this.inputs[name] === value) return;
    this.inputs[name] = value;
    if (value === UNSAFE[name]) this.fail(name.toUpperCase());
    else if (name === "key") this.keyTurned = true;
  }

  areInputsSafe() {
    return Object.entries(UNSAFE).every(([name, unsafe]) => this.inputs[name] !== unsafe);
  }

  /** Measure both mirrors, and tell whether they follow; while a move settles, the last answer stands. */
  areMirrorsFollowing() {
    const { feedback_codes } = this.settings;
    if (!feedback_codes) return true;
    this.measured = this.hooks.readMirrors();
    if (this.now >= this.settledAt) {
      const away = Math.max(...["x", "y"].map((axis) => Math.abs(this.measured[axis] - this.position[axis])));
      this.follows = away <= feedback_codes;
    }
    return this.follows;
  }

  watchMirrors() {
    const followed = this.follows;
    if (!this.areMirrorsFollowing() && followed) this.fail("SCAN");
  }

  lease(durationMs) {
    if (!LEASED.includes(this.state)) return;
    const until = this.now + 1000 * Math.min(durationMs, this.limits.lease_ms);
    if (until <= this.leaseUntil) return;
    this.leaseUntil = until;
    this.hooks.log({ event: "lease", until_us: until });
  }

  // --- messages: each returns "" or the NAK's reason ------------------------------------------------------------------

  tighten(requested) {
    if (this.state !== "DISARMED" && this.state !== "FAULT") return "STATE";
    for (const name of LIMIT_NAMES) {
      if (name === "full_power_uw") continue;
      const tighter = LESS_IS_TIGHTER.includes(name) ? Math.min : Math.max;
      this.limits[name] = tighter(this.limits[name], requested[name]);
    }
    return CONSUMED;
  }

  requestArming(hostNonce) {
    if (this.state !== "DISARMED") return "STATE";
    if (!this.isVersionKnown) return "VERSION";
    if (!this.areInputsSafe() || !this.follows) return "INPUT";
    if (this.settings.key_edge && !this.keyTurned) return "KEY_EDGE";
    this.change("ARMING", "arm requested");
    this.arming = { since: this.now, hostNonce, boardNonce: randomBytes(4).readUInt32LE(), confirmedAt: null };
    this.leaseUntil = 0;
    this.lease(this.limits.lease_ms);
    this.hooks.send("ARM_CHALLENGE", { host_nonce: hostNonce, board_nonce: this.arming.boardNonce });
    return CONSUMED;
  }

  confirmArming({ host_nonce, board_nonce }) {
    const { arming } = this;
    if (this.state !== "ARMING" || arming.confirmedAt !== null) return "STATE";
    if (host_nonce !== arming.hostNonce || board_nonce !== arming.boardNonce) {
      this.change("DISARMED", "disarm");
      return "NONCE";
    }
    arming.confirmedAt = this.now;
    this.keyTurned = false;
    return CONSUMED;
  }

  disarm() {
    this.end("disarm");
    return CONSUMED;
  }

  clearFault() {
    if (this.state !== "FAULT") return "STATE";
    if (!this.areInputsSafe() || !this.follows) return "INPUT";
    this.fault = "";
    this.underrunTimes = [];
    this.change("DISARMED", "fault cleared");
    return CONSUMED;
  }

  flush() {
    if (!QUEUEING.includes(this.state)) return "STATE";
    this.closeGate("flush");
    this.drop();
    if (this.state !== "ARMED") this.change("ARMED", "flush");
    return CONSUMED;
  }

  addPoints(first, points) {
    if (!QUEUEING.includes(this.state)) return "STATE";
    const mayJump = !this.job && !this.queue.length;
    if (first < this.nextNumber || (first > this.nextNumber && !mayJump)) return "INDEX";
    if (first + points.length > NUMBERS - 1) return "INDEX";
    if (points.length > this.freePoints()) return "NO_ROOM";
    const fault = points.map((point) => this.checkPoint(point)).find(Boolean);
    if (fault) {
      this.fail(fault);
      return "STATE";
    }
    if (mayJump) this.doneIndex = first;
    this.queue.push(...points.map((point, k) => ({ ...point, index: first + k })));
    this.nextNumber = first + points.length;
    this.refill();
    return CONSUMED;
  }

  checkPoint({ x, y, on_us, duty }) {
    const { limits } = this;
    if (x < limits.x_min || x > limits.x_max || y < limits.y_min || y > limits.y_max) return "RANGE";
    if (on_us > limits.max_on_us) return "ON_TIME";
    return duty > limits.max_duty ? "DUTY" : "";
  }

  start({ job, first_index, start_tick, watermark }) {
    if (this.state !== "ARMED") return "STATE";
    if (first_index !== (this.queue.length ? this.queue[0].index : this.nextNumber)) return "INDEX";
    const startAt = Math.max(this.now, this.bootUs + start_tick);
    this.job = { number: job, watermark, startAt, endIndex: null, beginsAt: null };
    this.change("RUNNING", "start");
    this.refill();
    return CONSUMED;
  }

  startOnTrigger({ job, first_index, delay_us, wait_ms }) {
    if (this.state !== "ARMED") return "STATE";
    if (!this.queue.length || first_index !== this.queue[0].index) return "INDEX";
    const trigger = { from: this.now, until: this.now + 1000 * wait_ms, delayUs: delay_us };
    this.job = { number: job, watermark: 1, startAt: null, endIndex: null, beginsAt: null, trigger };
    this.change("RUNNING", "start");
    return CONSUMED;
  }

  /** Count an edge at the trigger input, and let the job that awaits one begin its delay after it. */
  noticeTrigger(at) {
    this.triggers = { count: (this.triggers.count + 1) % NUMBERS, tick: at - this.bootUs };
    const trigger = this.job?.trigger;
    if (!trigger || at < trigger.from || at >= trigger.until) return;
    this.job.trigger = null;
    this.job.startAt = at + trigger.delayUs;
    this.refill();
  }

  endJob({ job, end_index }) {
    if (!this.job || this.job.number !== job) return "STATE";
    if (end_index !== this.nextNumber) return "INDEX";
    this.job.endIndex = end_index;
    if (this.doneIndex === end_index && !this.current) this.finishJob();
    else this.refill();
    return CONSUMED;
  }

  freePoints() {
    return this.settings.queue_points - this.queue.length;
  }

  /** Let a job that waits for points go on as soon as it has enough. */
  refill() {
    if (!this.job || this.job.trigger || this.current || this.job.beginsAt !== null) return;
    const isWhole = this.job.endIndex !== null;
    if (!isWhole && this.queue.length < Math.max(1, this.job.watermark)) return;
    this.job.beginsAt = Math.max(this.now, this.job.startAt);
    if (this.state === "HOLD") this.change("RUNNING", "refilled");
  }

  finishJob() {
    this.job = null;
    this.change("ARMED", "job done");
  }

  // --- time -----------------------------------------------------------------------------------------------------------

  /** Return the next event as [time, action], of several in one tick the first by rank; null: none is due. */
  nextEvent() {
    const events = [];
    if (LEASED.includes(this.state)) events.push([this.leaseUntil, () => this.fail("LINK")]);
    if (this.arming) events.push(this.armingEvent());
    if (this.state === "HOLD") events.push([this.holdSince + HOLD_US, () => this.change("DISARMED", "hold too long")]);
    if (this.state === "RUNNING") events.push(this.runningEvent());
    return events.reduce((first, event) => (first && first[0] <= event[0] ? first : event), null);
  }

  armingEvent() {
    const { since, confirmedAt } = this.arming;
    if (confirmedAt === null) return [since + ARMING_US, () => this.change("DISARMED", "arming timed out")];
    return [Math.max(since + INDICATOR_US, confirmedAt), () => this.change("ARMED", "armed")];
  }

  runningEvent() {
    const { job, current } = this;
    if (current) return current.isLit ? [current.offAt, () => this.endPulse()] : [current.onAt, () => this.endDark()];
    if (job.trigger) return [job.trigger.until, () => this.change("DISARMED", "hold too long")];
    if (job.beginsAt !== null) return [job.beginsAt, () => this.beginPoint()];
    return [job.startAt + HOLD_US, () => this.change("DISARMED", "hold too long")];
  }

  run(until) {
    for (let event = this.nextEvent(); event && event[0] <= until; event = this.nextEvent()) {
      this.now = Math.max(this.now, event[0]);
      event[1]();
    }
    this.now = until;
  }

  // --- points ---------------------------------------------------------------------------------------------------------

  beginPoint() {
    const point = this.queue.shift();
    const distance = Math.max(Math.abs(point.x - this.position.x), Math.abs(point.y - this.position.y));
    this.settledAt = Math.max(this.now, this.settledAt) + this.settlingUs(distance);
    this.position = { x: point.x, y: point.y };
    this.hooks.move(point.x, point.y);
    this.current = { ...point, isLit: false, onAt: Math.max(this.now + point.dark_us, this.settledAt) };
  }

  settlingUs(distance) {
    const { settle_us, settle_ns_per_code } = this.limits;
    return distance ? settle_us + Math.ceil((distance * settle_ns_per_code) / 1000) : 0;
  }

  endDark() {
    const { current } = this;
    if (!current.on_us) {
      this.hooks.record(current.index, this.tick, 0, 0);
      this.endPoint();
      return;
    }
    const fault = this.areMirrorsFollowing() ? this.accounts.begin(current, this.now, this.limits) : "SCAN";
    if (fault) {
      this.fail(fault);
      return;
    }
    current.isLit = true;
    current.offAt = this.now + current.on_us;
    this.setGate(true, `point ${current.index}`);
  }

  endPulse() {
    this.closeGate(`point ${this.current.index} done`);
    this.endPoint();
  }

  endPoint() {
    this.doneIndex = this.current.index + 1;
    this.current = null;
    if (this.doneIndex === this.job.endIndex) this.finishJob();
    else if (this.queue.length) this.beginPoint();
    else this.underrun();
  }

  underrun() {
    this.underruns += 1;
    this.underrunTimes = this.underrunTimes.filter((time) => this.now - time <= UNDERRUN_WINDOW_US);
    this.underrunTimes.push(this.now);
    if (this.underrunTimes.length >= UNDERRUNS_MAX) {
      this.fail("UNDERRUN");
      return;
    }
    this.job.beginsAt = null;
    this.holdSince = this.now;
    this.change("HOLD", "queue empty");
  }

  setGate(on, reason) {
    this.isGateOn = on;
    this.hooks.setGate(on);
    this.hooks.log({ event: "gate", on, reason });
  }

  /** Turn the gate off if it is on, and account for the pulse that ends; a reset leaves nothing to account for. */
  closeGate(reason) {
    if (!this.isGateOn) return;
    this.setGate(false, reason);
    if (reason === "reset") return;
    const { index, x, y, duty, on_us, offAt } = this.current;
    const onAt = offAt - on_us;
    this.hooks.log({ event: "pulse", index, x, y, duty, on_us: onAt, off_us: this.now });
    this.hooks.record(index, onAt - this.bootUs, this.now - onAt, duty);
    this.laserOnTimesDuty += (this.now - onAt) * duty;
  }
}
