// Calls to the daemon. The token lies in this daemon's own cookie; calls carry it as a bearer header.

const COOKIE = `optodrive-${location.port || "80"}=`;

export function token() {
  const own = document.cookie.split("; ").find((item) => item.startsWith(COOKIE));
  return own ? own.slice(COOKIE.length) : "";
}

// What the daemon refused, with its problem document; status 0 where nothing answered.
export class Problem extends Error {
  constructor(status, problem) {
    super(problem.detail || problem.title || `the daemon answered ${status}`);
    this.status = status;
    this.problem = problem;
  }
}

export function request(method, path, { body, signal } = {}) {
  const headers = { Authorization: `Bearer ${token()}` };
  if (body !== undefined) {
    headers["Content-Type"] = "application/json";
  }
  const text = body === undefined ? undefined : JSON.stringify(body);
  return fetch(path, { method, headers, body: text, signal, cache: "no-store" });
}

export async function call(method, path, options = {}) {
  let answer;
  try {
    answer = await request(method, path, options);
  } catch (error) {
    if (error.name === "AbortError") {
      throw error;
    }
    throw new Problem(0, { detail: "The daemon does not answer." });
  }
  const body = await answer.json().catch(() => ({}));
  if (!answer.ok) {
    throw new Problem(answer.status, body);
  }
  return body;
}
