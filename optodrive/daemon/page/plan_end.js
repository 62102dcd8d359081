// How a plan ended, in words: a caller who stops it is no failure.

// The errors of plans that STOP or Disarm ended, as the link process words them.
const STOPPED = ["ended by stop", "ended by disarm"];

// Return the words and the kind, "good", "bad" or "", of a plan with its status and error.
export function describeStatus({ status, error }) {
  if (status === "failed" && STOPPED.includes(error)) {
    return { text: `stopped (${error})`, kind: "" };
  }
  const kind = { done: "good", failed: "bad" }[status] ?? "";
  return { text: error ? `${status} (${error})` : status, kind };
}
