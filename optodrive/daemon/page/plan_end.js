// How a plan ended, in words: a caller who stops it is no failure.

// Return the words and the kind, "good", "bad" or "", of a plan with its status and error.
export function describeStatus({ status, error }) {
  const kind = { done: "good", failed: "bad" }[status] ?? "";
  return { text: error ? `${status} (${error})` : status, kind };
}
