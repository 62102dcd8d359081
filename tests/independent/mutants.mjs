// Boards that violate one guard each: the conformance suite must detect them.

import { Accounts } from "./accounts.mjs";
import { Board } from "./board.mjs";
import { Chip } from "./chip.mjs";
import { Machine } from "./machine.mjs";
import { LIMIT_NAMES } from "./wire.mjs";

const machine = Machine.prototype;
const { closeGate, endPulse, checkPoint, requestArming } = machine;
const { handle } = Board.prototype;
const BURN_ON_US = 1000;

const BREAK = {
  B1: () => {
    machine.closeGate = function closeOnlyAtTheEndOfAPulse(reason) {
      if (reason.startsWith("point")) closeGate.call(this, reason);
    };
  },
  B2: () => {
    machine.endPulse = function burnUntilMorePoints() {
      if (this.queue.length) endPulse.call(this);
      else this.current.offAt += BURN_ON_US;
    };
  },
  B3: () => {
    Board.prototype.handle = function renewByAnything(message) {
      this.machine.leaseUntil = Math.max(this.machine.leaseUntil, this.machine.now + 1000 * this.machine.limits.lease_ms);
      handle.call(this, message);
    };
  },
  B4: () => {
    Accounts.prototype.onTime = () => 0;
  },
  B5: () => {
    Accounts.prototype.exceedsMeanPower = Accounts.prototype.lacksMemory = () => "";
  },
  B6: () => {
    Accounts.prototype.energyUj = () => 0;
  },
  B7: () => {
    machine.settlingUs = () => 0;
  },
  B8: () => {
    machine.checkPoint = function ignoreTheField(point) {
      const fault = checkPoint.call(this, point);
      return fault === "RANGE" ? "" : fault;
    };
  },
  B9: () => {
    machine.areInputsSafe = () => true;
  },
  B10: () => {
    machine.tighten = function take(requested) {
      for (const name of LIMIT_NAMES) this.limits[name] = requested[name];
      return "";
    };
  },
  B11: () => {
    machine.requestArming = function forgetTheKey(hostNonce) {
      this.keyTurned = true;
      return requestArming.call(this, hostNonce);
    };
  },
  B12: () => {
    machine.addPoints = function addAny(first, points) {
      this.queue.push(...points.map((point, k) => ({ ...point, index: first + k })));
      this.nextNumber = first + points.length;
      this.refill();
      return "";
    };
  },
  B13: () => {
    Board.prototype.handle = function abortByDamage(message) {
      handle.call(this, message.error === "crc_errors" ? { ...message, error: "", name: "ABORT" } : message);
    };
  },
  B14: () => {
    Chip.prototype.isTickLate = () => false;
  },
  B15: () => {
    Chip.prototype.isWatchdogDue = () => false;
  },
  B17: () => {
    machine.areMirrorsFollowing = function trust() {
      this.follows = true;
      return true;
    };
  },
};

/** Break a guard of every board of this process. */
export function breakGuard(guard) {
  BREAK[guard]();
}
