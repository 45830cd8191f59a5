"use strict";
// Draws the figure of the page, and lights up the tour of one UAV. Written without `eval`, inline handlers and requests, so
// that the page's Content-Security-Policy can forbid them.
(() => {
  const map = document.getElementById("map");
  const scale = document.getElementById("scale");
  const page = JSON.parse(document.getElementById("page").textContent);
  const buttons = [...document.querySelectorAll("button[data-uav]")];
  const DIMMED = 0.12;
  const NEAR = 8; // Pixels between a click and the line that it means.
  const STILL = 5; // Pixels that a pointer may move in a click.
  const PAUSE = 120; // Milliseconds.
  let pause = 0;
  let lit = null;
  let size = null;

  const of = (role) => map.data.flatMap((trace, index) => (trace.meta.role === role ? [index] : []));

  function light(uav) {
    lit = uav === lit ? null : uav;
    const shines = ({ meta }) => lit === null || meta.uav === lit || ["depot", "key"].includes(meta.role);
    Plotly.restyle(map, {
      opacity: map.data.map((trace) => (shines(trace) ? 1 : DIMMED)),
      "line.width": map.data.map(({ meta }) => (meta.role === "tour" ? (meta.uav === lit ? 4.5 : 2.5) : undefined)),
    });
    for (const button of buttons) {
      const on = Number(button.dataset.uav) === lit;
      button.setAttribute("aria-pressed", String(on));
      button.closest("tr").classList.toggle("lit", on);
    }
    map.dataset.lit = lit === null ? "" : String(lit);
  }

  const axes = () => [map._fullLayout.xaxis, map._fullLayout.yaxis];
  const pixelsPerMeter = () => {
    const [x] = axes();
    return x._length / Math.abs(x.range[1] - x.range[0]);
  };

  // Stops are as large as the distance between them allows; where they are large enough, they are numbered and legs have
  // arrows.
  function resize() {
    const [smallest, largest, numbered, share] = page.sizes;
    const room = page.spacing > 0 ? page.spacing * share * pixelsPerMeter() : largest;
    const wanted = Math.round(Math.min(Math.max(room, smallest), largest));
    if (wanted === size) return;
    size = wanted;
    const hasText = size >= numbered;
    const modes = hasText ? { stops: "markers+text", tour: "lines+markers" } : { stops: "markers", tour: "lines" };
    const sizes = { stops: size, skipped: Math.min(size, page.largestSkipped) };
    // One call for all traces, because each call draws everything. What is undefined stays as it is.
    Plotly.restyle(map, {
      mode: map.data.map(({ meta }) => modes[meta.role]),
      "marker.size": map.data.map(({ meta }) => sizes[meta.role]),
      "textfont.size": map.data.map(({ meta }) => (meta.role === "stops" ? Math.max(8, Math.round(size * 0.55)) : undefined)),
    });
  }

  function drawScale() {
    const [x, y] = axes();
    const most = 140 / pixelsPerMeter();
    const power = 10 ** Math.floor(Math.log10(most));
    const meters = [5, 2, 1].find((digit) => digit * power <= most) * power;
    scale.textContent = meters >= 1000 ? `${meters / 1000} km` : `${Number(meters.toPrecision(1))} m`;
    scale.style.width = `${meters * pixelsPerMeter()}px`;
    scale.style.left = `${x._offset + 12}px`;
    scale.style.top = `${y._offset + y._length - 32}px`;
  }

  // The UAV whose stop, or else whose line, is at a point of the window; null on empty ground, undefined beside the map.
  function uavAt(event) {
    const box = map.querySelector(".nsewdrag").getBoundingClientRect();
    const at = [event.clientX - box.left, event.clientY - box.top];
    if (at[0] < 0 || at[1] < 0 || at[0] > box.width || at[1] > box.height) return undefined;
    const [x, y] = axes();
    const corners = (trace) => trace.x.map((value, index) => [x.d2p(value), y.d2p(trace.y[index])]);
    let best = null;
    let bestLength = Infinity;
    const consider = (trace, length, limit) => {
      if (length <= limit && length < bestLength) [best, bestLength] = [trace.meta.uav, length];
    };
    const shown = (role) => of(role).map((index) => map.data[index]).filter((trace) => trace.visible !== "legendonly");
    for (const trace of shown("stops")) {
      for (const [left, top] of corners(trace)) consider(trace, Math.hypot(left - at[0], top - at[1]), size / 2 + 1);
    }
    if (best !== null) return best;
    for (const trace of shown("tour")) {
      const points = corners(trace);
      for (let end = 1; end < points.length; end += 1) consider(trace, toSegment(at, points[end - 1], points[end]), NEAR);
    }
    return best;
  }

  function toSegment(at, from, to) {
    const along = [to[0] - from[0], to[1] - from[1]];
    const square = along[0] ** 2 + along[1] ** 2;
    const dot = (at[0] - from[0]) * along[0] + (at[1] - from[1]) * along[1];
    const part = square > 0 ? Math.min(Math.max(dot / square, 0), 1) : 0;
    return Math.hypot(from[0] + part * along[0] - at[0], from[1] + part * along[1] - at[1]);
  }

  function listen() {
    // Plotly tells clicks on points only, and covers the map while it is dragged.
    let down = null;
    map.addEventListener("pointerdown", (event) => {
      down = event.button === 0 && !event.target.closest(".modebar, .legend") ? event : null;
    }, true);
    window.addEventListener("pointerup", (event) => {
      const isClick = down !== null && Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) < STILL;
      down = null;
      const uav = isClick ? uavAt(event) : undefined;
      if (uav !== undefined && (uav !== null || lit !== null)) light(uav === null ? lit : uav);
    }, true);
    window.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && lit !== null) light(lit);
    });
    for (const button of buttons) button.addEventListener("click", () => light(Number(button.dataset.uav)));
    map.on("plotly_afterplot", () => {
      drawScale();
      // While somebody zooms, there is a plot after every turn of the wheel.
      window.clearTimeout(pause);
      pause = window.setTimeout(resize, PAUSE);
    });
  }

  const { data, layout } = page.figure;
  if (map.clientWidth < 800) layout.legend = { ...layout.legend, orientation: "h", y: -0.15 };
  const config = {
    responsive: true,
    scrollZoom: true,
    // To everything, from any view; a button leads back to the view of the beginning.
    doubleClick: "autosize",
    // Newer versions of plotly wait longer, and take clicks on two stops for a double-click.
    doubleClickDelay: 300,
    displaylogo: false,
    plotlyServerURL: "",
    // Those that plotly adds by itself differ between its versions, and some share the figure with a service.
    modeBarButtons: [["toImage"], ["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]],
    toImageButtonOptions: { filename: "map", scale: 2 },
  };
  Plotly.newPlot(map, data, layout, config).then(() => {
    listen();
    drawScale();
    resize();
    map.dataset.lit = "";
    map.dataset.ready = "yes";
  });
})();
