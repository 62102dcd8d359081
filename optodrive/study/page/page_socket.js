// The WebSocket of a page: opened with the token behind # in the address, and opened again when it is lost.

export const NORMAL = 1000, INVALID = 1008, UNAUTHORISED = 4401, REPLACED = 4409; // codes of the server
const RETRY_MS = 500;
const FINAL = [NORMAL, INVALID, UNAUTHORISED, REPLACED];

export class PageSocket {
  // path: of the WebSocket; onView: gets each view; onLost: gets the code of a close, and whether it is tried again
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
    const scheme = location.protocol.replace("http", "ws");
    const socket = new WebSocket(`${scheme}//${location.host}${this.path}`, ["optodrive", `bearer.${encodeBase64url(token)}`]);
    this.socket = socket;
    socket.addEventListener("message", ({ data }) => this.onView(JSON.parse(data)));
    socket.addEventListener("close", ({ code }) => {
      const isFinal = FINAL.includes(code);
      this.onLost(code, !isFinal);
      if (!isFinal) {
        setTimeout(() => this.#open(), RETRY_MS);
      }
    });
  }
}

function encodeBase64url(text) {
  return btoa(text).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}
