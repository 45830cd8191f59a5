// The card of a task or a route, and the table of UAVs.
import { element, kilometers, minutes, number } from "./tools.js";

export function showDetails(card, state, actions) {
  const { selected } = state;
  // Typing must not lose its place.
  if (
    selected?.task &&
    card.dataset.task === selected.task &&
    card.contains(document.activeElement) &&
    document.activeElement.tagName === "INPUT"
  )
    return;
  card.replaceChildren();
  card.hidden = true;
  delete card.dataset.task;
  if (!selected) return;
  const task = selected.task === undefined ? null : state.tasks.tasks.find((one) => one.id === selected.task);
  const route = selected.route === undefined ? null : state.report?.routes[selected.route];
  if (!task && !route) return;
  card.hidden = false;
  const close = button("✕", () => actions.select(null), "close");
  close.setAttribute("aria-label", "Close");
  card.append(close);
  if (task) {
    card.dataset.task = task.id;
    taskCard(card, task, state, actions);
  } else routeCard(card, route, actions);
}

function taskCard(card, task, state, actions) {
  card.append(element("h3", `Task ${task.id}`), facts(placeInPlan(task, state)));
  const names = state.tasks.system === "wgs84" ? ["Latitude", "Longitude"] : ["x", "y"],
    grid = element("div", "", "grid");
  const entry = (label, value, low, high, set) => {
    const input = element("input"),
      box = element("label", `${label} `);
    Object.assign(input, { type: "number", step: "any", min: low, max: high, value });
    input.addEventListener("change", () => {
      if (Number.isNaN(input.valueAsNumber) || !input.validity.valid) {
        input.value = value;
        return;
      }
      set(input.valueAsNumber);
      actions.changed();
    });
    box.append(input);
    grid.append(box);
  };
  entry("Value", task.value, 0, 1e9, (value) => {
    task.value = value;
  });
  entry("Service, s", task.service_s, 0, 1e6, (value) => {
    task.service_s = value;
  });
  const most = state.tasks.system === "wgs84" ? [90, 180] : [1e9, 1e9];
  names.forEach((name, axis) =>
    entry(name, task.point[axis], -most[axis], most[axis], (value) => {
      task.point[axis] = value;
    }),
  );
  const must = element("input"),
    box = element("label", "", "inline");
  Object.assign(must, { type: "checkbox", checked: task.must });
  must.addEventListener("change", () => {
    task.must = must.checked;
    actions.changed();
  });
  box.append(must, " must be served");
  const row = element("div", "", "row");
  row.append(
    button(task.forbidden ? "Allow" : "Forbid", () => actions.forbid(task)),
    button("Move", () => actions.setMode("move")),
    button("Delete", () => actions.remove(task)),
  );
  card.append(grid, box, row);
}

function placeInPlan(task, state) {
  if (task.forbidden) return [["Forbidden", "no UAV goes there"]];
  const { report } = state;
  if (!report) return [];
  for (const route of report.routes) {
    const stop = route.stops.indexOf(task.id);
    if (stop >= 0) {
      const flown = route.legs_m.slice(0, stop + 1).reduce((sum, leg) => sum + leg, 0);
      return [
        ["UAV", route.uav],
        ["Stop", `${stop + 1} of ${route.stops.length}`],
        ["Last leg", kilometers(route.legs_m[stop])],
        ["Flown so far", kilometers(flown)],
      ];
    }
  }
  const skipped = report.skipped.find((one) => one.id === task.id);
  return skipped ? [["Skipped", skipped.text]] : [["Not planned yet", "plan again"]];
}

function routeCard(card, route, actions) {
  const list = element("ol");
  route.stops.forEach((id, stop) => {
    const item = element("li"),
      link = button(`${id}`, () => actions.select({ task: id }), "link");
    item.append(link, ` after ${kilometers(route.legs_m[stop])}`);
    list.append(item);
  });
  card.append(
    element("h3", route.uav),
    facts([
      ["Stops", String(route.stops.length)],
      ["Value", number(route.value)],
      ["Length", kilometers(route.length_m)],
      ...(route.service_m ? [["Service", kilometers(route.service_m)]] : []),
      ["Used of the range", `${(route.share_of_range * 100).toFixed(1)} % of ${kilometers(route.range_m)}`],
      ["Left for the plan", kilometers(Math.max(route.usable_m - route.used_m, 0))],
      ...(route.seconds === null ? [] : [["Time in the air", minutes(route.seconds)]]),
    ]),
    list,
  );
}

// One row of inputs for each UAV.
export function uavRows(body, uavs, changed) {
  if (body.contains(document.activeElement) && body.children.length === uavs.length) return;
  body.replaceChildren(
    ...uavs.map((uav) => {
      const row = element("tr");
      const cell = (value, set, type = "number", label = "") => {
        const input = element("input"),
          data = element("td");
        Object.assign(input, { type, value: value ?? "", step: "any" });
        input.setAttribute("aria-label", label);
        input.addEventListener("change", () => {
          set(type === "number" ? input.valueAsNumber : input.value);
          changed();
        });
        data.append(input);
        row.append(data);
      };
      cell(
        uav.id,
        (value) => {
          uav.id = value;
        },
        "text",
        "Name",
      );
      cell(
        uav.range_m / 1000,
        (value) => {
          uav.range_m = value * 1000;
        },
        "number",
        "Range in kilometers",
      );
      cell(
        uav.speed_mps,
        (value) => {
          uav.speed_mps = Number.isNaN(value) ? null : value;
        },
        "number",
        "Speed in meters per second",
      );
      cell(
        uav.reserve_percent,
        (value) => {
          uav.reserve_percent = Number.isNaN(value) ? 0 : value;
        },
        "number",
        "Reserve in percent",
      );
      return row;
    }),
  );
}

function facts(pairs) {
  const list = element("dl");
  for (const [name, value] of pairs) list.append(element("dt", name), element("dd", value));
  return list;
}

function button(text, action, className = "") {
  const made = element("button", text, className);
  made.type = "button";
  made.addEventListener("click", action);
  return made;
}
