// A board as a process in virtual time. Its first line on stdin are its settings, each further one a request; each is
// answered by a line with the bytes for the host, the new entries of the log and the new edges of the gate.
//
//   {"uid": …, "queue_points": …, "max_on_us": …, …}
//   {"do": "advance" | "receive" | "input" | "trigger" | "reset" | "inject" | "close", "at": µs, …}

import { readSync, writeSync } from "node:fs";

import { Chip } from "./chip.mjs";
import { breakGuard } from "./mutants.mjs";

const STDIN = 0;
const STDOUT = 1;
const CHUNK = 65536;

function* readLines() {
  const chunk = Buffer.alloc(CHUNK);
  let rest = "";
  for (let count = readSync(STDIN, chunk); count; count = readSync(STDIN, chunk)) {
    const lines = (rest + chunk.toString("latin1", 0, count)).split("\n");
    rest = lines.pop();
    yield* lines;
  }
}

const ACTIONS = {
  advance: () => {},
  receive: (chip, { data }) => chip.receive(Buffer.from(data, "hex")),
  input: (chip, { name, value }) => chip.setInput(name, value),
  trigger: (chip) => chip.trigger(),
  reset: (chip, { at }) => chip.reset(at),
  inject: (chip, { fault }) => chip.inject(fault),
  close: (chip) => chip.loseLink(),
};

function serve() {
  const [guard] = process.argv.slice(2);
  if (guard) breakGuard(guard);
  let chip = null;
  let log = [];
  for (const line of readLines()) {
    const request = JSON.parse(line);
    if (!chip) {
      chip = new Chip(request, (entry) => log.push(entry));
    } else {
      chip.advance(request.at ?? chip.now);
      ACTIONS[request.do](chip, request);
    }
    const answer = { data: chip.takeOutput().toString("hex"), log, edges: chip.edges };
    log = [];
    chip.edges = [];
    writeSync(STDOUT, `${JSON.stringify(answer)}\n`);
  }
}

serve();
