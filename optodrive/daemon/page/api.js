// Requests to the daemon. The token is in a cookie named after the daemon's port; requests send it as a bearer header.

const COOKIE = `optodrive-${location.port || "80"}=`;

export function token() {
  const cookie = document.cookie.split("; ").find((item) => item.startsWith(COOKIE));
  return cookie ? cookie.slice(COOKIE.length) : "";
}

// An error response with its problem document; status 0 if the daemon does not answer.
export class Problem extends Error {
  constructor(status, problem) {
    super(problem.detail || problem.title || `the daemon answered ${status}`);
    this.status = status;
    this.problem = problem;
  }
}

// path: from the root of the daemon, which a proxy may show below a path of its own.
export function request(method, path, { body, signal } = {}) {
  const headers = { Authorization: `Bearer ${token()}` };
  if (body !== undefined) {
    headers["Content-Type"] = "application/json";
  }
  const text = body === undefined ? undefined : JSON.stringify(body);
  return fetch(`.${path}`, { method, headers, body: text, signal, cache: "no-store" });
}

export async function call(method, path, options = {}) {
  let response;
  try {
    response = await request(method, path, options);
  } catch (error) {
    if (error.name === "AbortError") {
      throw error;
    }
    throw new Problem(0, { detail: "The daemon does not answer." });
  }
  const body = await response.json().catch(() => ({}));
  if (response.status === 403) {
    dispatchEvent(new Event("refused")); // the token may have another role than before
  }
  if (!response.ok) {
    throw new Problem(response.status, body);
  }
  return body;
}
