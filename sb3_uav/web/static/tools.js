// Small helpers: elements, requests, numbers.

export const $ = (id) => document.getElementById(id);

export function element(tag, text = "", className = "") {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

// A request to the server this page comes from; errors carry the sentence of the server.
export async function ask(method, path, body) {
  const isFile = body instanceof Blob;
  const answer = await fetch(path, {
    method,
    headers: body === undefined ? {} : { "content-type": isFile ? "application/octet-stream" : "application/json" },
    body: body === undefined || isFile ? body : JSON.stringify(body),
  });
  if (answer.status === 401) location.replace("/login");
  const found = await answer.json().catch(() => ({ detail: `The server answered ${answer.status}.` }));
  if (!answer.ok) throw Object.assign(new Error(found.detail), { status: answer.status });
  return found;
}

// Show what went wrong; nothing when null.
export function refuse(error) {
  $("error").hidden = error === null;
  $("error").firstElementChild.textContent = error === null ? "" : error.message;
}
document.querySelector("#error button")?.addEventListener("click", () => refuse(null));

export const number = (value) => Number(value.toPrecision(6)).toLocaleString("en-US", { maximumFractionDigits: 2 });
export const kilometers = (meters) => (meters >= 1000 ? `${(meters / 1000).toFixed(2)} km` : `${meters.toFixed(0)} m`);
export const minutes = (seconds) => {
  // Rounded before it is divided, else there would be 60 s.
  const whole = Math.round(seconds);
  return whole >= 60 ? `${Math.floor(whole / 60)} min ${whole % 60} s` : `${whole} s`;
};
