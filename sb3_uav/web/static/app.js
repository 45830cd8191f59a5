// The page: what the user has entered (the draft, kept by the server), and the plans that come back.
// Everything of the user is put into the page as text, never as HTML.
import { exampleTasks, field, fleet } from "./forms.js";
import { MissionMap } from "./map.js";
import { showDetails, uavRows } from "./panels.js";
import { isUnderway, leave, showProgress } from "./progress.js";
import { showResult } from "./results.js";
import { Tiles } from "./tiles.js";
import { $, ask, element, refuse } from "./tools.js";

const FIELDS = [
  "count",
  "range",
  "range-unit",
  "speed",
  "reserve",
  "time",
  "seed",
  "altitude",
  "altitude-step",
  "firmware",
  "vehicle",
  "landing",
];
const POLL_MS = 250;

const emptyTasks = () => ({ system: $("system").value, meters_per_unit: 1, depot: null, source: "drawn by hand", tasks: [] });
const state = {
  tasks: emptyTasks(),
  uavs: null,
  solve: null,
  stale: false,
  progress: null,
  report: null,
  selected: null,
  mode: null,
  limits: null,
};
const map = new MissionMap($("map"), clicked);
$("map").mission = map;

// The draft on the server.
let saving = false,
  again = false;
async function save() {
  if (saving) {
    again = true;
    return;
  }
  saving = true;
  try {
    const form = Object.fromEntries(FIELDS.map((name) => [name, $(name).value]));
    await ask("PUT", "/session", {
      tasks: state.tasks,
      uavs: state.uavs,
      solve: state.solve,
      form: { ...form, stale: state.stale, duplicates: $("duplicates").checked },
    });
  } catch (error) {
    refuse(error);
  }
  saving = false;
  if (again) {
    again = false;
    save();
  }
}

async function load() {
  state.limits = await ask("GET", "/api/v1/limits");
  if (state.limits.tiles) map.tiles = new Tiles(state.limits.tiles, () => map.draw());
  if (map.tiles) {
    $("attribution").hidden = false;
    $("attribution").textContent = `Map tiles: ${new URL(state.limits.tiles.replace("{s}", "a")).host}`;
  }
  const draft = await ask("GET", "/session");
  if (draft) {
    Object.assign(state, { tasks: draft.tasks, uavs: draft.uavs, solve: draft.solve, stale: draft.form.stale === true });
    for (const name of FIELDS) if (typeof draft.form[name] === "string") $(name).value = draft.form[name];
    $("duplicates").checked = draft.form.duplicates === true;
    $("system").value = draft.tasks.system;
  } else {
    // Without tiles, there is nothing to find a latitude on.
    $("system").value = map.tiles ? "wgs84" : "plane";
    state.tasks = emptyTasks();
  }
  show();
  map.fit();
  if (state.solve) follow();
  document.body.dataset.ready = "yes";
}

// A change of tasks or fleet.
function changed() {
  // A solve that has no plan yet works on the old tasks, too.
  state.stale = state.report !== null || isUnderway(state.progress);
  show();
  save();
}

function show() {
  const { tasks } = state,
    list = tasks.tasks,
    must = list.filter((task) => task.must).length,
    forbidden = list.filter((task) => task.forbidden).length;
  const system =
    tasks.system === "wgs84"
      ? "latitude, longitude"
      : tasks.meters_per_unit === 1
        ? "x, y in meters"
        : `x, y in units of ${tasks.meters_per_unit} m`;
  $("tasks-summary").textContent =
    list.length || tasks.depot
      ? [
          `${list.length} tasks`,
          must && `${must} must be served`,
          forbidden && `${forbidden} forbidden`,
          tasks.depot ? "" : "no depot yet",
          system,
          tasks.source,
        ]
          .filter(Boolean)
          .join(" · ")
      : "No tasks yet.";
  $("system-label").hidden = list.length > 0 || tasks.depot !== null;
  $("example").hidden = list.length > 0;
  $("clear").hidden = !list.length && !tasks.depot;
  $("equal").hidden = state.uavs !== null;
  $("individual").hidden = state.uavs === null;
  $("split").textContent = state.uavs ? "Use equal UAVs" : "Set each UAV by itself";
  uavRows($("uavs"), state.uavs ?? [], changed);
  const waits = isUnderway(state.progress);
  $("solve").hidden = waits;
  $("cancel").hidden = !waits;
  $("solve").disabled = !list.length;
  $("solve").textContent = state.report ? "Plan again" : "Plan the mission";
  $("stale").hidden = !state.stale;
  showMap();
  showResult(state, select, showTask);
}

function showMap() {
  const { tasks } = state;
  map.selected = state.selected;
  map.pointing = state.mode !== null;
  $("map").classList.toggle("pointing", map.pointing);
  map.show({
    system: tasks.system,
    metersPerUnit: tasks.meters_per_unit,
    tasks: tasks.tasks,
    depot: tasks.depot,
    routes: state.report?.routes ?? [],
  });
  const hints = {
    add: "Click on the map to add tasks. Escape ends it.",
    depot: "Click where the UAVs start and land.",
    move: "Click the new place of the task.",
  };
  const empty = !tasks.tasks.length && !tasks.depot && state.mode === null;
  $("hint").hidden = !state.mode && !empty;
  $("hint").textContent = state.mode ? hints[state.mode] : "Drop a file of tasks anywhere, or add tasks by click.";
  $("add").setAttribute("aria-pressed", state.mode === "add");
  $("depot").setAttribute("aria-pressed", state.mode === "depot");
  showDetails($("details"), state, { changed, select, setMode, forbid, remove });
}

function showTask(id) {
  const task = taskOf(id);
  if (!task) return;
  select({ task: id });
  map.center(task.point);
}
const taskOf = (id) => state.tasks.tasks.find((task) => task.id === id);

function select(what) {
  state.selected = what;
  showMap();
  showResult(state, select, showTask);
}
function setMode(mode) {
  state.mode = state.mode === mode ? null : mode;
  showMap();
}
function forbid(task) {
  task.forbidden = !task.forbidden;
  changed();
}
function remove(task) {
  state.tasks.tasks.splice(state.tasks.tasks.indexOf(task), 1);
  state.selected = null;
  changed();
}

function clicked(point, under) {
  const rounded = point.map((value) => Number(value.toFixed(state.tasks.system === "wgs84" ? 7 : 3)));
  const isEarth = state.tasks.system !== "wgs84" || (Math.abs(point[0]) <= 90 && Math.abs(point[1]) <= 180);
  if (state.mode === "move" && state.selected?.task && isEarth) {
    taskOf(state.selected.task).point = rounded;
    state.mode = null;
    changed();
  } else if (state.mode === "depot" && isEarth) {
    state.tasks.depot = rounded;
    state.mode = null;
    changed();
  } else if (state.mode === "add" && isEarth) {
    if (state.limits && state.tasks.tasks.length >= state.limits.max_tasks)
      return refuse(new Error(`This server admits ${state.limits.max_tasks} tasks.`));
    let count = state.tasks.tasks.length + 1;
    const taken = new Set(state.tasks.tasks.map((task) => task.id));
    while (taken.has(`t${count}`)) count++;
    state.tasks.tasks.push({
      id: `t${count}`,
      point: rounded,
      value: 1,
      service_s: 0,
      must: false,
      altitude_m: null,
      forbidden: false,
    });
    changed();
  } else select(under);
}

async function takeFile(file) {
  if (!file) return;
  refuse(null);
  if (state.limits && file.size > state.limits.max_body_mb * 2 ** 20)
    return refuse(
      new Error(`${file.name} has ${(file.size / 2 ** 20).toFixed(0)} MiB; this server admits ${state.limits.max_body_mb}.`),
    );
  $("tasks-summary").textContent = `Reading ${file.name} …`;
  try {
    const { uavs, notes, ...tasks } = await ask(
      "POST",
      `/api/v1/tasks?name=${encodeURIComponent(file.name)}&allow_duplicates=${$("duplicates").checked}`,
      file,
    );
    tasks.tasks.forEach((task) => {
      task.forbidden = false;
    });
    leave(state.progress);
    Object.assign(state, {
      tasks,
      uavs: uavs ?? state.uavs,
      report: null,
      solve: null,
      progress: null,
      selected: null,
      mode: null,
      stale: false,
    });
    $("system").value = tasks.system;
    $("state").textContent = "";
    $("progress").hidden = true;
    changed();
    map.fit();
    if (notes.length) refuse(new Error(notes.join(" ")));
  } catch (error) {
    refuse(error);
    show();
  }
}

async function takeFleet(file) {
  if (!file) return;
  refuse(null);
  try {
    const { uavs, system } = await ask("POST", `/api/v1/fleets?name=${encodeURIComponent(file.name)}`, file);
    if (system && system !== state.tasks.system && uavs.some((uav) => uav.start || uav.end))
      throw new Error(`${file.name}: the starts and ends of these UAVs have other coordinates than the tasks.`);
    state.uavs = uavs;
    changed();
  } catch (error) {
    refuse(error);
  }
}

async function solve() {
  refuse(null);
  // A double click is one solve.
  $("solve").disabled = true;
  $("state").dataset.state = "sent";
  try {
    const options = {
      time_limit: field("time", "The time"),
      seed: field("seed", "The seed"),
      allow_duplicates: $("duplicates").checked,
    };
    state.progress = await ask("POST", "/api/v1/solves", { tasks: state.tasks, fleet: fleet(state.uavs), options });
    state.solve = state.progress.id;
    state.stale = false;
    state.selected = null;
    state.mode = null;
    show();
    save();
    follow();
  } catch (error) {
    refuse(error);
  } finally {
    $("solve").disabled = !state.tasks.tasks.length;
  }
}

// Ask for news until the solve is over. A newer solve ends an older loop.
async function follow() {
  const name = state.solve;
  let seen = -1;
  while (state.solve === name) {
    try {
      const progress = await ask("GET", `/api/v1/solves/${encodeURIComponent(name)}`);
      if (state.solve !== name) return;
      state.progress = progress;
      showProgress(state.progress);
      if (progress.version !== seen && progress.has_plan) {
        const { report } = await ask("GET", `/api/v1/solves/${encodeURIComponent(name)}/plan`);
        if (state.solve !== name) return;
        state.report = report;
      }
      if (progress.version !== seen) show();
      seen = progress.version;
      if (!isUnderway(progress)) return;
    } catch (error) {
      if (error.status === 404) {
        Object.assign(state, { solve: null, progress: null, report: null });
        show();
        return;
      }
      if (error.status) {
        refuse(error);
        return;
      }
      $("state").textContent = "The server does not answer; trying again …";
      await pause(2000);
    }
    await pause(POLL_MS);
  }
}

const pause = (time) => new Promise((done) => setTimeout(done, time));

function example() {
  leave(state.progress);
  Object.assign(state, {
    tasks: exampleTasks(),
    solve: null,
    report: null,
    progress: null,
  });
  $("range").value = "15";
  $("range-unit").value = "km";
  changed();
  map.fit();
}

function clear() {
  leave(state.progress);
  Object.assign(state, {
    tasks: emptyTasks(),
    uavs: null,
    solve: null,
    report: null,
    progress: null,
    selected: null,
    mode: null,
  });
  $("state").textContent = "";
  $("progress").hidden = true;
  changed();
  map.fit();
}

$("file").addEventListener("change", (event) => {
  takeFile(event.target.files[0]);
  event.target.value = "";
});
$("fleet-file").addEventListener("change", (event) => {
  takeFleet(event.target.files[0]);
  event.target.value = "";
});
for (const type of ["dragover", "dragleave", "drop"]) {
  document.addEventListener(type, (event) => {
    event.preventDefault();
    document.body.classList.toggle("dragging", type === "dragover");
    const file = type === "drop" ? event.dataTransfer.files[0] : undefined;
    if (file && /fleet[^/]*\.csv$/i.test(file.name)) takeFleet(file);
    else takeFile(file);
  });
}
$("add").addEventListener("click", () => setMode("add"));
$("depot").addEventListener("click", () => setMode("depot"));
$("example").addEventListener("click", example);
// Asked for twice, because nothing brings it back.
$("clear").addEventListener("click", () => {
  const isSure = $("clear").dataset.asked === "yes";
  $("clear").dataset.asked = isSure ? "" : "yes";
  $("clear").textContent = isSure ? "Clear all" : "Really clear all?";
  if (isSure) clear();
});
$("clear").addEventListener("blur", () => {
  $("clear").dataset.asked = "";
  $("clear").textContent = "Clear all";
});
$("system").addEventListener("change", () => {
  state.tasks = emptyTasks();
  changed();
  map.fit();
});
$("split").addEventListener("click", () => {
  try {
    if (state.uavs) state.uavs = null;
    else {
      const { count, ...uav } = fleet(null);
      if (!(count >= 1 && count <= 100)) throw new Error("Give 1 to 100 UAVs.");
      state.uavs = Array.from({ length: count }, (_, index) => ({ id: `uav-${index + 1}`, ...uav, start: null, end: null }));
    }
    changed();
  } catch (error) {
    refuse(error);
  }
});
for (const name of FIELDS)
  $(name).addEventListener("change", () => {
    if (["count", "range", "range-unit", "speed", "reserve"].includes(name)) changed();
    else {
      showResult(state, select, showTask);
      save();
    }
  });
$("duplicates").addEventListener("change", save);
$("solve").addEventListener("click", solve);
$("cancel").addEventListener("click", async () => {
  try {
    state.progress = await ask("DELETE", `/api/v1/solves/${encodeURIComponent(state.solve)}`);
    showProgress(state.progress);
    show();
  } catch (error) {
    refuse(error);
  }
});
$("zoom-in").addEventListener("click", () => map.zoom(1.5));
$("zoom-out").addEventListener("click", () => map.zoom(1 / 1.5));
$("fit").addEventListener("click", () => map.fit());
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") {
    state.mode = null;
    select(null);
  }
});
$("download").addEventListener("click", async (event) => {
  // Fetched, so that a refusal becomes a sentence instead of a page of JSON.
  event.preventDefault();
  refuse(null);
  $("download").textContent = "Writing the files …";
  try {
    const answer = await fetch($("download").href);
    if (!answer.ok) throw new Error((await answer.json()).detail);
    const link = element("a");
    link.href = URL.createObjectURL(await answer.blob());
    link.download = "mission.zip";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  } catch (error) {
    refuse(error);
  }
  $("download").textContent = "Download all files (zip)";
});

load().catch(refuse);
