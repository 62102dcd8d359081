// The chip that the firmware runs on, in virtual time: a safety tick, a main loop, an alarm, the gate's pin with its
// readback, and a watchdog; written from PROTOCOL.md alone: B1, B9, B14, B15 and B17.

import { Board } from "./board.mjs";

const TICK_US = 100;
const LATE_US = 500;
const READBACK_US = 100;
const LATE_TICK_US = 1000;
const WATCHDOG_US = 40_000;
const CENTRE = 32768;
const SLOW_US = 20_000;
const DISCONNECTED_CODE = 72_000;
const CAUSES = { powerUp: 0, reset: 1, watchdog: 3 };

export class Chip {
  constructor(settings, log) {
    this.settings = settings;
    this.now = 0;
    this.log = (entry) => log({ t_us: this.now, ...entry });
    this.inputs = { interlock: true, key: true, estop: false };
    this.edges = [];
    this.triggers = 0;
    this.isGateOn = false;
    this.mirrorFault = "";
    this.commanded = { x: CENTRE, y: CENTRE };
    this.reset(0, CAUSES.powerUp);
  }

  // --- pins -----------------------------------------------------------------------------------------------------------

  setGate(on) {
    this.sampleReadback();
    if (this.isGateOn !== on) this.edges.push([this.now, on]);
    this.isGateOn = on;
  }

  readGate() {
    return this.frozenReadback ?? this.isGateOn;
  }

  /** Add up how long the readback has differed, apart for pulses and for dark gaps; agreement forgets it. */
  sampleReadback() {
    const phase = this.isGateOn ? "on" : "off";
    const differs = this.readGate() !== this.isGateOn;
    this.differingUs[phase] = differs ? this.differingUs[phase] + this.now - this.sampledAt : 0;
    this.sampledAt = this.now;
    return this.differingUs[phase] > READBACK_US;
  }

  move(x, y) {
    this.before = this.commanded;
    this.commanded = { x, y };
    this.movedAt = this.now;
  }

  /** Mirrors that follow at once, unless x is broken. */
  readMirrors() {
    const { x, y } = this.commanded;
    if (this.mirrorFault === "unplug_mirror") return { x: DISCONNECTED_CODE, y };
    if (this.mirrorFault === "stick_mirror") return { x: this.stuckX, y };
    const isLate = this.mirrorFault === "slow_mirror" && this.now < this.movedAt + SLOW_US;
    return { x: isLate ? this.before.x : x, y };
  }

  // --- faults and inputs from outside ---------------------------------------------------------------------------------

  setInput(name, value) {
    if (this.inputs[name] === value) return;
    this.inputs[name] = value;
    this.log({ event: "input", input: name, value });
  }

  /** An edge at the trigger input, whose time the timer captures for the next tick. */
  trigger() {
    this.capturedAt = this.now;
    this.triggers += 1;
    this.log({ event: "trigger", count: this.triggers });
  }

  inject(fault) {
    if (fault === "stop_loop") this.isLoopStopped = true;
    if (fault === "stop_tick") this.isTickStopped = true;
    if (fault === "late_tick") this.tickResumesAt = this.now + LATE_TICK_US;
    if (fault === "stick_gate") this.frozenReadback = this.isGateOn;
    if (fault.endsWith("_mirror") || fault === "repair") {
      this.before = this.readMirrors(); // slow from the next move on
      this.stuckX = this.before.x;
      this.mirrorFault = fault;
    }
  }

  /** Begin anew: hardware turns the gate off, and all that the firmware knew is lost. */
  reset(now, cause = CAUSES.reset) {
    this.now = this.bootUs = now;
    if (this.board) {
      this.board.machine.now = now;
      this.board.machine.closeGate("reset");
    }
    this.isLoopStopped = this.isTickStopped = false;
    this.tickResumesAt = 0;
    this.frozenReadback = null;
    this.differingUs = { on: 0, off: 0 };
    this.sampledAt = this.tickedAt = this.fedAt = now;
    this.hasTicked = false;
    this.capturedAt = null;
    this.input = [];
    this.move(CENTRE, CENTRE);
    const hooks = {
      log: this.log,
      setGate: (on) => this.setGate(on),
      move: (x, y) => this.move(x, y),
      readMirrors: () => this.readMirrors(),
    };
    this.board = new Board(this.settings, hooks, this.inputs, now, cause);
  }

  // --- time -----------------------------------------------------------------------------------------------------------

  /** Advance: an alarm carries out each event at its own time, tick and main loop run at every hundred microseconds. */
  advance(until) {
    for (let next = this.nextTick(); next <= until; next = this.nextTick()) {
      this.carryOutUntil(next);
      this.now = next;
      if (!this.isTickStopped && this.now >= this.tickResumesAt) this.runTick();
      if (!this.isLoopStopped) this.runLoop();
      if (this.isWatchdogDue()) this.reset(this.now, CAUSES.watchdog);
    }
    this.carryOutUntil(until);
    this.now = until;
    this.receive([]);
  }

  nextTick() {
    const since = this.now - this.bootUs;
    return this.bootUs + (Math.floor(since / TICK_US) + 1) * TICK_US;
  }

  /** Carry out what is due by the alarm, which is an interrupt of the timer like the tick. */
  carryOutUntil(until) {
    while (!this.isTickStopped && until >= this.tickResumesAt) {
      const event = this.board.machine.nextEvent();
      if (!event || event[0] > until) break;
      this.now = Math.max(this.now, this.tickResumesAt, event[0]);
      if (this.isTickLate()) break;
      this.board.run(this.now);
    }
  }

  isTickLate() {
    return this.now - this.tickedAt > TICK_US + LATE_US;
  }

  isWatchdogDue() {
    return this.now - this.fedAt >= WATCHDOG_US;
  }

  runTick() {
    const { machine } = this.board;
    machine.now = this.now;
    if (this.isTickLate()) machine.fail("TICK");
    this.tickedAt = this.now;
    this.hasTicked = true;
    for (const [name, value] of Object.entries(this.inputs)) machine.setInput(name, value);
    machine.watchMirrors();
    if (this.sampleReadback()) machine.fail("READBACK");
    if (this.capturedAt !== null) machine.noticeTrigger(this.capturedAt);
    this.capturedAt = null;
    this.board.run(this.now);
  }

  runLoop() {
    const { machine } = this.board;
    machine.now = this.now;
    if (this.isTickLate()) machine.fail("TICK");
    if (this.hasTicked) {
      this.hasTicked = false;
      this.fedAt = this.now;
    }
    this.receive([]);
    this.board.report(this.now);
  }

  /** Take bytes from the line. The main loop reads them at once, or when it runs again. */
  receive(data) {
    this.input.push(...data);
    if (this.isLoopStopped || !this.input.length) return;
    const bytes = this.input;
    this.input = [];
    this.board.machine.now = this.now;
    this.board.receive(bytes);
    this.carryOutUntil(this.now);
  }

  loseLink() {
    this.board.machine.now = this.now;
    this.board.loseLink();
  }

  takeOutput() {
    return this.board.takeOutput();
  }
}
