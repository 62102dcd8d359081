// Generated from firmware_protocol/messages.toml by generate.py: do not edit.

export const BoardState = Object.freeze({
  BOOT: "BOOT",
  DISARMED: "DISARMED",
  ARMING: "ARMING",
  ARMED: "ARMED",
  RUNNING: "RUNNING",
  HOLD: "HOLD",
  FAULT: "FAULT",
});

export const LEASED_STATES = Object.freeze([BoardState.ARMING, BoardState.ARMED, BoardState.RUNNING, BoardState.HOLD]);

export const ARMED_STATES = Object.freeze([BoardState.ARMED, BoardState.RUNNING, BoardState.HOLD]);

export const IDLE_STATES = Object.freeze([BoardState.DISARMED, BoardState.FAULT]);

// The inputs by bit, bit 0 first.
export const INPUTS = Object.freeze(["interlock", "key", "estop"]);
