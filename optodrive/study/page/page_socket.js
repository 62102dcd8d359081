// The WebSocket of a page: opened with the token behind # in the address, and opened again when it is lost.

export const NORMAL = 1000, INVALID = 1008, UNAUTHORISED = 4401, REPLACED = 4409; // codes of the server
const RETRY_MS = 500;
const FINAL_CODES = [NORMAL, INVALID, UNAUTHORISED, REPLACED];
const FINAL_PHASES = ["done", "stopped"];

export class PageSocket {
  // path: of the WebSocket from the page's folder; onView: gets each view; onLost: gets the code of a close, and whether it is tried again
  constructor(path, onView, onLost) {
    this.path = path;
    this.onView = onView;
    this.onLost = onLost;
    this.#open();
  }

  // Send a message. What cannot be sent now is dropped: the next view tells the state.
  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) {
      this.socket.send(JSON.stringify(message));
    }
  }

  #open() {
    const token = new URLSearchParams(location.hash.slice(1)).get("token") || "";
    const socket = new WebSocket(new URL(this.path, location.href.split("#")[0].replace("http", "ws")), ["optodrive", `bearer.${encodeBase64url(token)}`]);
    this.socket = socket;
    let isOver = false; // after the last view the connection may end in any way
    socket.addEventListener("message", ({ data }) => {
      const view = JSON.parse(data);
      isOver = FINAL_PHASES.includes(view.phase);
      this.onView(view);
    });
    socket.addEventListener("close", ({ code }) => {
      const isTriedAgain = !isOver && !FINAL_CODES.includes(code);
      if (!isOver) {
        this.onLost(code, isTriedAgain);
      }
      if (isTriedAgain) {
        setTimeout(() => this.#open(), RETRY_MS);
      }
    });
  }
}

function encodeBase64url(text) {
  return btoa(text).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}
