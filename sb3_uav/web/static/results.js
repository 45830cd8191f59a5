// The result of a solve: figures, routes, and what is left out.
import { styleOf } from "./map.js";
import { $, element, kilometers, minutes, number } from "./tools.js";

// Figures, routes, skipped tasks and remarks of the plan in ``state``.
export function showResult(state, select, showTask) {
  const { report } = state;
  $("result").hidden = report === null;
  if (!report) return;
  const pairs = [
    ["Value", `${number(report.objective)} of ${number(report.total_value)}`],
    ...(report.bound !== null
      ? [
          ["Proven bound", number(report.bound)],
          ["Gap", `${(report.gap * 100).toFixed(1)} %`],
        ]
      : []),
    ["Tasks served", `${report.n_served} of ${report.n_tasks}`],
    ["Length", kilometers(report.length_m)],
    ...(report.unserved.length ? [["Must be served, but is not", report.unserved.join(", ")]] : []),
  ];
  $("figures").replaceChildren(...pairs.flatMap(([name, value]) => [element("dt", name), element("dd", value)]));
  $("routes").replaceChildren(
    ...report.routes.map((route, index) => {
      const button = element("button"),
        share = Math.round(route.share_of_range * 100);
      const swatch = element("canvas", "", "swatch");
      swatch.width = swatch.height = 12;
      const pen = swatch.getContext("2d");
      pen.fillStyle = styleOf(index).color;
      pen.fillRect(0, 0, 12, 12);
      const meter = element("meter", "", "share");
      meter.max = 1;
      meter.value = route.share_of_range;
      button.append(
        swatch,
        element("span", route.uav, "name"),
        element(
          "span",
          route.stops.length
            ? `${route.stops.length} stops · ${kilometers(route.length_m)} · ${share} %`
            : "stays on the ground",
          "meta",
        ),
        meter,
      );
      button.type = "button";
      button.dataset.route = index;
      button.title = `${route.uav}: ${share} % of its range${route.seconds === null ? "" : `, ${minutes(route.seconds)}`}`;
      button.setAttribute("aria-pressed", state.selected?.route === index);
      button.addEventListener("click", () => select(state.selected?.route === index ? null : { route: index }));
      return wrapped(button);
    }),
  );
  $("skipped-box").hidden = !report.skipped.length;
  $("skipped-box").firstElementChild.textContent = `Skipped tasks: ${report.skipped.length}`;
  $("skipped").replaceChildren(
    ...report.skipped.map((one) => {
      const button = element("button", `${one.id} `);
      button.type = "button";
      button.append(element("small", one.text));
      button.dataset.task = one.id;
      button.addEventListener("click", () => {
        showTask(one.id);
      });
      return wrapped(button);
    }),
  );
  $("remarks").replaceChildren(...report.remarks.map((sentence) => element("li", sentence)));
  const flight = new URLSearchParams({
    altitude_m: $("altitude").value,
    altitude_step_m: $("altitude-step").value,
    firmware: $("firmware").value,
    vehicle: $("vehicle").value,
    landing: $("landing").value,
  });
  $("download").href = `/api/v1/solves/${encodeURIComponent(state.solve)}/download?${flight}`;
}

const wrapped = (child) => {
  const item = element("li");
  item.append(child);
  return item;
};
