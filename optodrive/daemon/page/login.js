// Login: takes the token from the address or the form, stores it in a cookie named after the port, and loads the page.

const name = `optodrive-${location.port || "80"}`;

const ATTEMPTS = 20;
const RETRY_MS = 50;

// Return an error message; "" if the page reloads with the token.
async function signIn(token) {
  // Cookies and headers allow only these characters; generated tokens contain no others.
  const isValid = /^[\w.~+/=-]+$/.test(token);
  const headers = { Authorization: `Bearer ${token}` };
  if (!isValid || (await fetch("v1/state", { headers, cache: "no-store" })).status === 401) {
    return "This is not the token of the daemon that runs here now.";
  }
  // Below a proxy's path, so that the pages of several displays at one address keep a token each.
  document.cookie = `${name}=${token}; Path=${location.pathname}; SameSite=Strict`;
  // A busy browser may send a request before it has stored the cookie.
  for (let attempt = 0; attempt < ATTEMPTS; attempt += 1) {
    if ((await fetch("./", { cache: "no-store" })).ok) {
      location.reload();
      return "";
    }
    await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
  }
  return "This browser keeps no cookie for this page: allow cookies, since one holds the token.";
}

async function submit(token) {
  const message = document.getElementById("wrong");
  message.textContent = "";
  message.textContent = await signIn(token).catch(() => "The daemon does not answer; try again.");
  if (message.textContent) {
    document.getElementById("token").select();
  }
}

document.getElementById("form").addEventListener("submit", (event) => {
  event.preventDefault();
  submit(document.getElementById("token").value.trim());
});

function submitTokenOfAddress() {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (token) {
    history.replaceState(null, "", location.pathname);
    submit(token);
  }
}

// An address that differs only in its hash does not reload the page.
addEventListener("hashchange", submitTokenOfAddress);
submitTokenOfAddress();
