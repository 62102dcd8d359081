// A client that arms a board, plays its plan and asks what was executed, written from PROTOCOL.md alone: "Arming",
// "Jobs and points", "Reports", "Duties of the host".

import { HostLink, newNonce } from "./host_link.mjs";
import { JOBS, checkPlan } from "./plan.mjs";
import { LIMIT_NAMES, POINTS_MAX } from "./wire.mjs";

const CHALLENGE_US = 300_000;
const AHEAD_US = 400_000;
const REQUEST_EVERY_US = 30_000;

export class Client {
  constructor() {
    this.link = new HostLink();
    this.sent = 0;
    this.startTicks = [];
    this.step = this.play();
    this.waitsFor = null;
    this.isDone = false;
  }

  receive(data, now) {
    this.link.receive(data, now);
  }

  /** Go on as far as the board's answers permit. Return the bytes to send. */
  poll(now) {
    this.link.now = now;
    while (!this.isDone && (!this.waitsFor || this.waitsFor())) {
      const { value, done } = this.step.next();
      this.waitsFor = value;
      this.isDone = done;
    }
    return this.link.poll(now);
  }

  report() {
    const { hello, records, refusals, events, status } = this.link;
    const inOrder = [...records].sort(([one], [other]) => one - other);
    return { hello, jobs: JOBS, startTicks: this.startTicks, records: inOrder, refusals, events, status };
  }

  // --- the plan: each value that it yields is what must be true before it goes on -------------------------------------

  *play() {
    const { link } = this;
    yield () => link.hello;
    for (const points of JOBS) checkPlan(points, link.hello);
    yield () => link.clock && link.status;
    if (link.state === "FAULT") yield* this.order("CLEAR_FAULT");
    yield* this.tighten();
    yield* this.arm();
    for (const [number, points] of JOBS.entries()) yield* this.playJob(number + 1, points);
    yield* this.order("DISARM");
    yield () => link.state === "DISARMED";
  }

  /** Send a sequenced message and wait until it was carried out. */
  *order(name, values) {
    const { link } = this;
    link.send(name, values);
    yield () => link.isIdle();
    this.requireNoRefusal();
  }

  requireNoRefusal() {
    const [refusal] = this.link.refusals;
    if (refusal) throw new Error(`the board refused ${refusal.name}: ${refusal.reason}`);
  }

  *tighten() {
    const limits = Object.fromEntries(LIMIT_NAMES.map((name) => [name, this.link.hello[name]]));
    const points = JOBS.flat();
    limits.max_duty = Math.max(...points.map((point) => point.duty));
    limits.x_min = Math.min(...points.map((point) => point.x));
    limits.x_max = Math.max(...points.map((point) => point.x));
    yield* this.order("LIMITS", limits);
  }

  *arm() {
    const { link } = this;
    const host_nonce = newNonce();
    link.challenge = null;
    link.wantsLease = true;
    yield* this.order("ARM_REQ", { host_nonce });
    const until = link.now + CHALLENGE_US;
    yield () => link.challenge?.host_nonce === host_nonce || link.now > until;
    if (link.challenge?.host_nonce !== host_nonce) {
      yield* this.order("DISARM"); // the challenge was lost: start again
      yield* this.arm();
      return;
    }
    const { board_nonce } = link.challenge;
    yield* this.order("ARM_CONFIRM", { host_nonce, board_nonce });
    yield* this.reach("ARMED");
  }

  *reach(state) {
    const { link } = this;
    yield () => link.state === state || !link.wantsLease;
    if (link.state !== state) throw new Error(`the board is in ${link.state} ${link.fault}, not in ${state}`);
  }

  *playJob(job, points) {
    const { link } = this;
    const first = this.sent;
    const end = first + points.length;
    const start_tick = job === 1 ? 0 : link.boardTick() + AHEAD_US;
    this.startTicks.push(start_tick);
    const watermark = Math.min(points.length, Math.floor(link.hello.queue_points / 2));
    link.send("START", { job, first_index: first, start_tick, watermark });
    while (this.sent < end) {
      const room = link.doneIndex + link.hello.queue_points - this.sent;
      const count = Math.min(POINTS_MAX, end - this.sent, room);
      if (count > 0 && link.frames.length < 8) {
        link.send("DATA", { first_index: this.sent, points: points.slice(this.sent - first, this.sent - first + count) });
        this.sent += count;
      } else {
        const { statuses } = link;
        yield () => link.statuses > statuses || !link.wantsLease;
        this.requireArmed();
      }
    }
    link.send("END", { job, end_index: end });
    yield () => link.isIdle() || !link.wantsLease;
    yield () => (link.doneIndex === end && link.state === "ARMED") || !link.wantsLease;
    this.requireArmed();
    yield* this.collect(first, end);
  }

  requireArmed() {
    this.requireNoRefusal();
    if (!this.link.wantsLease) throw new Error(`the board left its arming: ${this.link.state} ${this.link.fault}`);
  }

  /** Ask again for reports that were lost. */
  *collect(first, end) {
    const { link } = this;
    for (let index = first; index < end; index++) {
      while (!link.records.has(index)) {
        const until = link.now + REQUEST_EVERY_US;
        yield () => link.records.has(index) || link.now > until;
        if (!link.records.has(index)) link.send("GET_EXECUTED", { first_index: index });
      }
    }
  }
}
