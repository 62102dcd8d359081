// The client as a process.
//
//   node client_process.mjs PORT      plays on a serial port and prints its report as a line of JSON
//   node client_process.mjs           in virtual time: for each line {"at": µs, "data": hex} on stdin one on stdout,
//                                     {"data": hex} or, at the end, {"report": …}

import { constants, openSync, writeSync } from "node:fs";
import { createInterface } from "node:readline";
import { ReadStream } from "node:tty";

import { Client } from "./client.mjs";

const POLL_MS = 2;
const US_PER_S = 1_000_000;

function playOnPort(path) {
  const port = openSync(path, constants.O_RDWR | constants.O_NOCTTY);
  const input = new ReadStream(port);
  input.setRawMode(true);
  const client = new Client();
  const leave = (status) => {
    if (status) writeAll(port, client.link.abort());
    process.exit(status);
  };
  const guarded = (action) => {
    try {
      action();
    } catch (error) {
      process.stderr.write(`${error.message}\n`);
      leave(1);
    }
  };
  const now = () => {
    const [seconds, nanoseconds] = process.hrtime();
    return seconds * US_PER_S + Math.floor(nanoseconds / 1000);
  };
  input.on("data", (data) => guarded(() => client.receive(data, now())));
  input.on("close", () => leave(1));
  for (const signal of ["SIGINT", "SIGTERM", "SIGHUP"]) process.on(signal, () => leave(1));
  setInterval(() => {
    guarded(() => writeAll(port, client.poll(now())));
    if (!client.isDone) return;
    process.stdout.write(`${JSON.stringify(client.report())}\n`, () => leave(0));
  }, POLL_MS);
}

function writeAll(port, data) {
  for (let at = 0; at < data.length; ) {
    try {
      at += writeSync(port, data, at);
    } catch (error) {
      if (error.code !== "EAGAIN") throw error;
    }
  }
}

function playInVirtualTime() {
  const client = new Client();
  createInterface({ input: process.stdin }).on("line", (line) => {
    const { at, data } = JSON.parse(line);
    client.receive(Buffer.from(data, "hex"), at);
    const out = client.poll(at).toString("hex");
    const answer = client.isDone ? { data: out, report: client.report() } : { data: out };
    process.stdout.write(`${JSON.stringify(answer)}\n`);
  });
}

const [path] = process.argv.slice(2);
if (path) playOnPort(path);
else playInVirtualTime();
