// How far a solve is.
import { $, ask, number, refuse } from "./tools.js";

export const isUnderway = (progress) => ["waiting", "running"].includes(progress?.state);

// Stop a solve that nobody looks at any more: the next one would wait for it.
export function leave(progress) {
  if (isUnderway(progress)) ask("DELETE", `/api/v1/solves/${encodeURIComponent(progress.id)}`).catch(() => {});
}

// Bar, curve and sentence of a solve.
export function showProgress(progress) {
  const isRunning = progress.state === "running";
  const sentences = {
    waiting: progress.error
      ? progress.error
      : progress.place
        ? `${progress.place} ${progress.place === 1 ? "solve" : "solves"} before this one in the queue.`
        : progress.ready
          ? "Starts as soon as a solver is free (next in the queue)."
          : "The solver is being started; the first time takes up to a minute.",
    running: progress.has_plan
      ? `Value ${number(progress.objective)} after ${progress.elapsed_s.toFixed(1)} s; getting better …`
      : "Looking for a first plan …",
    done: `Done in ${progress.elapsed_s.toFixed(1)} s.`,
    failed: "No plan.",
    canceled: progress.has_plan ? "Stopped; the best plan so far is shown." : "Stopped before there was a plan.",
  };
  $("state").textContent = sentences[progress.state];
  $("state").dataset.state = progress.state;
  if (progress.state === "failed") refuse(new Error(progress.error));
  $("progress").hidden = !(isRunning || progress.history.length > 1);
  $("progress").querySelector("i").style.width =
    `${Math.min(100, progress.state === "done" ? 100 : (100 * progress.elapsed_s) / progress.time_limit)}%`;
  drawCurve(progress);
}

function drawCurve({ history, time_limit, elapsed_s }) {
  const canvas = $("curve"),
    pen = canvas.getContext("2d"),
    { width, height } = canvas;
  pen.clearRect(0, 0, width, height);
  if (!history.length) return;
  const low = history[0][1],
    high = Math.max(history.at(-1)[1], low + 1e-9),
    end = Math.max(time_limit, elapsed_s);
  const place = ([seconds, value]) => [
    (seconds / end) * (width - 4) + 2,
    height - 6 - ((value - low) / (high - low)) * (height - 12),
  ];
  pen.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue("--accent");
  pen.lineWidth = 2;
  pen.beginPath();
  let y = place(history[0])[1];
  pen.moveTo(place(history[0])[0], y);
  for (const [px, py] of history.map(place)) {
    pen.lineTo(px, y);
    pen.lineTo(px, py);
    y = py;
  }
  pen.lineTo(place([elapsed_s, high])[0], y);
  pen.stroke();
}
