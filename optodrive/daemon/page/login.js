// Takes the token from the address or the form, keeps it in a cookie of this daemon's own, and asks again.

const name = `optodrive-${location.port || "80"}`;

const TRIES = 20;
const NEXT_TRY_MS = 50;

// What is wrong, "" where the page loads anew with the token.
async function tryToken(token) {
  // Only what a cookie and a header can hold; a token made here has nothing else.
  const fits = /^[\w.~+/=-]+$/.test(token);
  const headers = { Authorization: `Bearer ${token}` };
  if (!fits || (await fetch("/v1/state", { headers, cache: "no-store" })).status === 401) {
    return "This is not the token of the daemon that runs here now.";
  }
  document.cookie = `${name}=${token}; Path=/; SameSite=Strict`;
  // A busy browser may ask again before it has put the cookie away.
  for (let tried = 0; tried < TRIES; tried += 1) {
    if ((await fetch("/", { cache: "no-store" })).ok) {
      location.reload();
      return "";
    }
    await new Promise((resolve) => setTimeout(resolve, NEXT_TRY_MS));
  }
  return "This browser keeps no cookie for this page: allow one, it holds the token.";
}

async function submit(token) {
  const wrong = document.getElementById("wrong");
  wrong.textContent = "";
  wrong.textContent = await tryToken(token).catch(() => "The daemon does not answer; try again.");
  if (wrong.textContent) {
    document.getElementById("token").select();
  }
}

document.getElementById("form").addEventListener("submit", (event) => {
  event.preventDefault();
  submit(document.getElementById("token").value.trim());
});

function takeFromAddress() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    history.replaceState(null, "", location.pathname);
    submit(given);
  }
}

// An address that differs in its hash alone loads nothing anew.
addEventListener("hashchange", takeFromAddress);
takeFromAddress();
