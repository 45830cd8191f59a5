// Shows the token once; a cookie that scripts cannot read stands for it afterwards.
const form = document.getElementById("login");
form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const state = document.getElementById("state");
  state.textContent = "";
  try {
    const answer = await fetch("/login", {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify({ token: document.getElementById("token").value }),
    });
    if (answer.ok) location.replace("/");
    else state.textContent = (await answer.json()).detail;
  } catch {
    state.textContent = "The server does not answer.";
  }
});
