// Client of a display for JavaScript: frames of which the newest wins, the rate that is shown, hold-to-run and STOP.
//
// One module without dependencies, for browsers, Node.js 22 and later, and what embeds them (TouchDesigner's Web Render,
// Unity's WebGL). It speaks the WebSockets of docs/reference/streams.md. Copy it.
//
//   import { DisplayStream, Hold, stop } from "./optodrive.js";
//   const stream = new DisplayStream({ token });                 // an operator's; the board is armed
//   await stream.ready;
//   stream.onrate = ({ sent, shown }) => console.log(sent, shown);   // frames per second, each second
//   stream.send({ 17: 120, 18: 90.5 });                          // µm by pixel, or an array of all pixels
//   stream.close();                                              // pulses that have not left are dropped

const URL_DEFAULT = "ws://127.0.0.1:8450";
const RATE_EVERY_MS = 1000;
const BEAT_EVERY_MS = 400; // the daemon disarms a second after the last beat
const TENTHS_UM_MAX = 65535;
const RETRY_MS = 2;
const PIXEL = /^\d{1,6}$/;

/** Return the subprotocols that carry a token: a browser's WebSocket sends no header. */
function buildSubprotocols(token) {
  if (!token) throw new TypeError("token: missing, expected a token of the daemon");
  const bytes = new TextEncoder().encode(token);
  const text = btoa(String.fromCharCode(...bytes)).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
  return ["optodrive", `bearer.${text}`];
}

/** Open a WebSocket. Its `ready` resolves once it is open, and rejects if it is refused. */
function open(path, { url = URL_DEFAULT, token, WebSocket = globalThis.WebSocket }) {
  if (!WebSocket) throw new TypeError("WebSocket: missing, expected Node.js 22 or later, or the option WebSocket");
  const socket = new WebSocket(url.replace(/^http/, "ws").replace(/\/$/, "") + path, buildSubprotocols(token));
  socket.binaryType = "arraybuffer";
  const ready = new Promise((resolve, reject) => {
    socket.addEventListener("open", () => resolve());
    const refuse = () => reject(new Error(`${url}${path} is not reached, or refuses this token: its role is too low`));
    socket.addEventListener("error", refuse);
    socket.addEventListener("close", refuse);
  });
  ready.catch(() => {}); // a caller who does not wait for it is told by onclose
  return { socket, ready };
}

function checkHeight(height, pixel) {
  if (typeof height === "number" && height >= 0 && height <= TENTHS_UM_MAX / 10) return height;
  throw new RangeError(`heights[${pixel}]: got ${height}, expected a height in µm, 0 to ${TENTHS_UM_MAX / 10}`);
}

/** Return a frame as a message: bytes for heights of all pixels, text for heights by pixel. */
export function encodeFrame(number, heights) {
  if (Array.isArray(heights) || ArrayBuffer.isView(heights)) {
    const view = new DataView(new ArrayBuffer(8 + 2 * heights.length));
    [..."ODF1"].forEach((letter, at) => view.setUint8(at, letter.charCodeAt(0)));
    view.setUint32(4, number, true);
    for (let pixel = 0; pixel < heights.length; pixel += 1) {
      view.setUint16(8 + 2 * pixel, Math.round(10 * checkHeight(heights[pixel], pixel)), true);
    }
    return view.buffer;
  }
  const target_um = heights instanceof Map ? Object.fromEntries(heights) : { ...heights };
  for (const [pixel, height] of Object.entries(target_um)) {
    if (!PIXEL.test(pixel)) throw new RangeError(`heights: got ${pixel}, expected the number of a pixel`);
    checkHeight(height, pixel);
  }
  return JSON.stringify({ frame: number, target_um });
}

/**
 * A stream of frames.
 *
 * Options: url, token (operator), policy ("trim", "delay", "refuse"), standing, touchedOnly, WebSocket.
 * counts: frames sent, shown, superseded before their first pulse, and other (refused, stopped, failed)
 * onresult(result): each answer of the daemon; onrate({ sent, shown }): frames per second; onclose(code, reason)
 */
export class DisplayStream {
  constructor({ policy = "trim", standing = false, touchedOnly = false, ...options } = {}) {
    const query = new URLSearchParams({ policy, standing, touched_only: touchedOnly });
    const { socket, ready } = open(`/v1/stream?${query}`, options);
    this.ready = ready;
    this.counts = { sent: 0, shown: 0, superseded: 0, other: 0 };
    this.onresult = this.onrate = this.onclose = () => {};
    this._socket = socket;
    this._number = 0;
    this._waiting = null;
    this._timer = null;
    this._before = { ...this.counts, at: performance.now() };
    socket.addEventListener("message", (event) => this._read(JSON.parse(event.data)));
    socket.addEventListener("close", (event) => this._end(event));
    this._rates = setInterval(() => this._report(), RATE_EVERY_MS);
  }

  /** Show heights in µm in place of the rest of the frame before. Return the frame's number. */
  send(heights) {
    if (this._socket.readyState !== 1) throw new Error("the stream is not open: await ready, or open another");
    const number = this._number;
    const message = encodeFrame(number, heights);
    this._number = (number + 1) % 2 ** 32;
    this.counts.sent += 1;
    if (this._waiting !== null) this.counts.superseded += 1; // it still waited here for the network
    this._waiting = message;
    this._flush();
    return number;
  }

  /** Close the stream. Pulses that have not left for the board are dropped. */
  close() {
    this._waiting = null;
    this._socket.close();
  }

  _flush() {
    clearTimeout(this._timer);
    if (this._waiting === null || this._socket.readyState !== 1) return;
    if (this._socket.bufferedAmount > 0) {
      this._timer = setTimeout(() => this._flush(), RETRY_MS);
      return;
    }
    this._socket.send(this._waiting);
    this._waiting = null;
  }

  _read(result) {
    if (result.status !== "planned") {
      const isShown = result.status === "done" || result.executed > 0;
      this.counts[isShown ? "shown" : result.status === "superseded" ? "superseded" : "other"] += 1;
    }
    this.onresult(result);
  }

  _report() {
    const now = performance.now();
    const seconds = (now - this._before.at) / 1000;
    const { sent, shown } = this.counts;
    this.onrate({ sent: (sent - this._before.sent) / seconds, shown: (shown - this._before.shown) / seconds });
    this._before = { ...this.counts, at: now };
  }

  _end({ code, reason }) {
    clearInterval(this._rates);
    clearTimeout(this._timer);
    this.onclose(code, reason);
  }
}

/**
 * Arming that lasts as long as this object, its page and its connection: the board disarms, dark, without them.
 *
 * Options: url, token (armer), WebSocket. armed: resolves once the board is armed, rejects with the reason if not.
 * onend(reason): the arming has ended
 */
export class Hold {
  constructor(options = {}) {
    const { socket, ready } = open("/v1/hold", options);
    this.onend = () => {};
    this._socket = socket;
    let isArmed = false;
    this.armed = new Promise((resolve, reject) => {
      ready.catch(reject);
      socket.addEventListener("message", (event) => {
        const report = JSON.parse(event.data);
        if (report.status === "armed") {
          isArmed = true;
          resolve();
        } else {
          const reason = report.reason ?? report.problem?.detail ?? report.status;
          if (isArmed) this.onend(reason);
          isArmed = false;
          reject(new Error(reason));
        }
      });
      socket.addEventListener("close", () => {
        clearInterval(this._beats);
        if (isArmed) this.onend("the connection has ended");
        isArmed = false;
        reject(new Error("the connection has ended"));
      });
    });
    this.armed.catch(() => {});
    const beat = () => socket.readyState === 1 && socket.send("beat");
    socket.addEventListener("open", beat);
    this._beats = setInterval(beat, BEAT_EVERY_MS);
  }

  /** End the arming: dark, disarmed. */
  close() {
    this._socket.close();
  }
}

/** Stop the display: dark, disarmed. Any token may. Rejects if no answer confirms it: use the emergency stop then. */
export async function stop({ url = URL_DEFAULT, token } = {}) {
  const address = `${url.replace(/^ws/, "http").replace(/\/$/, "")}/v1/stop`;
  const answer = await fetch(address, { method: "POST", headers: { Authorization: `Bearer ${token}` } });
  if (!answer.ok) throw new Error(`stop was not confirmed (${answer.status}): use the emergency stop or the key`);
  return answer.json();
}
