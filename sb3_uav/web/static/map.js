// A map on a canvas: tasks, routes, depot; moving, zooming, and what lies under the pointer. No outside request, unless there
// are tiles. Latitudes and longitudes are drawn in the Mercator projection, as tiles are.

// Those of all pictures of the package, in the order of the fleet.
const COLORS = ["#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#8c6d31", "#000000"];
const INKS = ["#fff", "#000", "#fff", "#fff", "#000", "#000", "#fff", "#fff"];
const DASHES = [[], [9, 5], [2, 5], [12, 4, 2, 4]];
const TASK_REACH = 13,
  ROUTE_REACH = 8;

const isDark = matchMedia("(prefers-color-scheme: dark)");
export const styleOf = (route) => ({
  color: isDark.matches && route % COLORS.length === 7 ? "#e0e0e0" : COLORS[route % COLORS.length],
  ink: isDark.matches && route % COLORS.length === 7 ? "#000" : INKS[route % COLORS.length],
  dash: DASHES[Math.floor(route / COLORS.length) % DASHES.length],
});

export class MissionMap {
  constructor(canvas, onClick) {
    this.canvas = canvas;
    this.onClick = onClick;
    this.tasks = [];
    this.routes = [];
    this.depot = null;
    this.system = "plane";
    this.metersPerUnit = 1;
    this.roleOf = new Map();
    this.selected = null;
    this.pointing = false;
    this.tiles = null;
    this.x = 0;
    this.y = 0;
    this.scale = 1;
    this.pointers = new Map();
    this.moved = 0;
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom(Math.exp(-event.deltaY * 0.0015), ...this.at(event));
      },
      { passive: false },
    );
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const type of ["pointerup", "pointercancel"]) canvas.addEventListener(type, (event) => this.up(event));
    canvas.addEventListener("keydown", (event) => this.key(event));
    isDark.addEventListener("change", () => this.draw());
    this.resize();
  }

  // From the coordinates of the user to the flat world: to the right and down, degrees or units of the plane.
  world(point) {
    if (this.system === "plane") return [point[0], -point[1]];
    const latitude = (Math.max(-85.05, Math.min(85.05, point[0])) * Math.PI) / 180;
    return [
      this.reference + wrap(point[1] - this.reference),
      (-Math.log(Math.tan(Math.PI / 4 + latitude / 2)) * 180) / Math.PI,
    ];
  }

  user(x, y) {
    if (this.system === "plane") return [x, -y];
    return [((2 * Math.atan(Math.exp((-y * Math.PI) / 180)) - Math.PI / 2) * 180) / Math.PI, wrap(x)];
  }

  screen([x, y]) {
    return [(x - this.x) * this.scale + this.width / 2, (y - this.y) * this.scale + this.height / 2];
  }
  pixel(point) {
    return this.screen(this.world(point));
  }
  userAt(px, py) {
    return this.user((px - this.width / 2) / this.scale + this.x, (py - this.height / 2) / this.scale + this.y);
  }
  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }
  pixelOfTask(id) {
    const task = this.tasks.find((one) => one.id === id);
    return task && this.pixel(task.point);
  }

  show({ system, metersPerUnit, tasks, depot, routes }) {
    this.system = system;
    this.metersPerUnit = metersPerUnit;
    this.tasks = tasks;
    this.depot = depot;
    this.routes = routes;
    this.reference = depot ? depot[1] : tasks.length ? tasks[0].point[1] : 0;
    this.roleOf = new Map();
    routes.forEach((route, number) => route.stops.forEach((id, stop) => this.roleOf.set(id, [number, stop + 1])));
    this.draw();
  }

  fit() {
    const points = [...this.tasks.map((task) => task.point), ...(this.depot ? [this.depot] : [])].map((point) =>
      this.world(point),
    );
    if (!points.length) {
      [this.x, this.y] = this.system === "plane" ? [500, -500] : [0, 0];
      this.scale = this.system === "plane" ? Math.min(this.width, this.height) / 1200 : this.width / 360;
      return this.draw();
    }
    const [left, right] = span(points, 0),
      [top, bottom] = span(points, 1);
    this.x = (left + right) / 2;
    this.y = (top + bottom) / 2;
    const least = this.system === "plane" ? 1 : 1e-4;
    this.scale = Math.min(
      (this.width - 90) / Math.max(right - left, least),
      (this.height - 90) / Math.max(bottom - top, least),
    );
    this.scale = Math.max(this.scale, 1e-9);
    this.draw();
  }

  center(point) {
    [this.x, this.y] = this.world(point);
    this.draw();
  }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const wanted = Math.max(1e-9, Math.min(1e9, this.scale * factor));
    this.x += (px - this.width / 2) * (1 / this.scale - 1 / wanted);
    this.y += (py - this.height / 2) * (1 / this.scale - 1 / wanted);
    this.scale = wanted;
    this.draw();
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    if (!this.pointers.size) this.moved = 0;
    this.pointers.set(event.pointerId, this.at(event));
  }

  move(event) {
    const now = this.at(event),
      before = this.pointers.get(event.pointerId);
    if (!before) {
      this.canvas.classList.toggle("over", !this.pointing && this.under(...now) !== null);
      return;
    }
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    if (others.length) {
      const [other] = others;
      this.zoom(
        Math.hypot(now[0] - other[0], now[1] - other[1]) / Math.max(Math.hypot(before[0] - other[0], before[1] - other[1]), 1),
        ...other,
      );
    } else {
      this.x -= (now[0] - before[0]) / this.scale;
      this.y -= (now[1] - before[1]) / this.scale;
    }
    this.moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
    this.pointers.set(event.pointerId, now);
    if (this.moved > 3) this.draw();
  }

  up(event) {
    const was = this.pointers.delete(event.pointerId);
    if (was && event.type === "pointerup" && !this.pointers.size && this.moved <= 5) {
      const place = this.at(event);
      this.onClick(this.userAt(...place), this.under(...place));
    }
  }

  key(event) {
    const step = 60 / this.scale;
    const keys = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (keys[event.key]) {
      this.x += keys[event.key][0];
      this.y += keys[event.key][1];
      this.draw();
    } else if (event.key === "+" || event.key === "=") this.zoom(1.4);
    else if (event.key === "-") this.zoom(1 / 1.4);
    else return;
    event.preventDefault();
  }

  // The task or the route at a place of the screen.
  under(px, py) {
    let best = null,
      reach = TASK_REACH;
    for (const task of this.tasks) {
      const [x, y] = this.pixel(task.point),
        far = Math.hypot(x - px, y - py);
      if (far < reach) {
        reach = far;
        best = { task: task.id };
      }
    }
    if (best) return best;
    reach = ROUTE_REACH;
    this.routes.forEach((route, number) => {
      if (!route.stops.length) return;
      const places = route.points.map((point) => this.pixel(point));
      for (let leg = 1; leg < places.length; leg++) {
        const far = toSegment([px, py], places[leg - 1], places[leg]);
        if (far < reach) {
          reach = far;
          best = { route: number };
        }
      }
    });
    return best;
  }

  resize() {
    const box = this.canvas.getBoundingClientRect(),
      ratio = window.devicePixelRatio || 1;
    const first = !this.width;
    this.width = Math.max(box.width, 1);
    this.height = Math.max(box.height, 1);
    this.canvas.width = Math.round(this.width * ratio);
    this.canvas.height = Math.round(this.height * ratio);
    this.ratio = ratio;
    if (first) this.fit();
    else this.draw();
  }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.drawNow();
    });
  }

  drawNow() {
    const pen = this.canvas.getContext("2d"),
      css = getComputedStyle(document.documentElement);
    const color = (name) => css.getPropertyValue(`--${name}`).trim();
    pen.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    if (this.tiles && this.system === "wgs84") this.tiles.draw(pen, this);
    else this.drawGrid(pen, color("grid"), color("soft"));
    this.routes.forEach((route, number) => {
      if (route.stops.length) this.drawRoute(pen, route, number, color("halo"));
    });
    const area = this.tasks.length ? this.spacing() : 0;
    const numbered = area > 24,
      radius = numbered ? 9 : Math.max(2.5, Math.min(6, area / 3));
    for (const task of this.tasks) this.drawTask(pen, task, radius, numbered, color);
    if (this.depot) this.drawDepot(pen, ...this.pixel(this.depot), color);
    this.drawScale(pen, color("ink"));
  }

  // Pixels that every task has for itself, about.
  spacing() {
    const points = this.tasks.map((task) => this.world(task.point));
    const [left, right] = span(points, 0),
      [top, bottom] = span(points, 1);
    return Math.sqrt(Math.max((right - left) * (bottom - top) * this.scale * this.scale, 1) / this.tasks.length) * 0.75;
  }

  drawRoute(pen, route, number, halo) {
    const { color, dash } = styleOf(number),
      places = route.points.map((point) => this.pixel(point));
    const isDim = this.selected && this.selected.route !== undefined && this.selected.route !== number;
    pen.globalAlpha = isDim ? 0.2 : 1;
    pen.lineJoin = "round";
    for (const [style, width, lines] of [
      [halo, 6, []],
      [color, this.selected?.route === number ? 4 : 2.4, dash],
    ]) {
      pen.strokeStyle = style;
      pen.lineWidth = width;
      pen.setLineDash(lines);
      pen.beginPath();
      places.forEach(([x, y], index) => (index ? pen.lineTo(x, y) : pen.moveTo(x, y)));
      pen.stroke();
    }
    pen.setLineDash([]);
    pen.fillStyle = color;
    for (let leg = 1; leg < places.length; leg++) arrow(pen, places[leg - 1], places[leg]);
    pen.globalAlpha = 1;
  }

  drawTask(pen, task, radius, numbered, color) {
    const [x, y] = this.pixel(task.point);
    if (x < -20 || y < -20 || x > this.width + 20 || y > this.height + 20) return;
    const role = this.roleOf.get(task.id);
    pen.globalAlpha = this.selected?.route !== undefined && role?.[0] !== this.selected.route ? 0.35 : 1;
    if (this.selected?.task === task.id) {
      pen.strokeStyle = color("accent");
      pen.lineWidth = 3;
      circle(pen, x, y, radius + 5);
      pen.stroke();
    }
    if (task.forbidden) {
      pen.strokeStyle = color("bad");
      pen.lineWidth = 2.5;
      const arm = Math.max(radius * 0.7, 4);
      pen.beginPath();
      pen.moveTo(x - arm, y - arm);
      pen.lineTo(x + arm, y + arm);
      pen.moveTo(x + arm, y - arm);
      pen.lineTo(x - arm, y + arm);
      pen.stroke();
    } else if (role) {
      const style = styleOf(role[0]);
      pen.fillStyle = style.color;
      pen.strokeStyle = color("halo");
      pen.lineWidth = 1.5;
      circle(pen, x, y, radius);
      pen.fill();
      pen.stroke();
      if (numbered) text(pen, String(role[1]), x, y, style.ink, role[1] > 99 ? 8 : 10);
    } else {
      pen.fillStyle = color("halo");
      pen.strokeStyle = color("task");
      pen.lineWidth = 2;
      circle(pen, x, y, Math.min(radius, 5.5));
      pen.fill();
      pen.stroke();
    }
    if (task.must && !task.forbidden) {
      pen.fillStyle = "#ffb000";
      pen.strokeStyle = color("halo");
      pen.lineWidth = 1;
      circle(pen, x + radius * 0.8, y - radius * 0.8, 3.5);
      pen.fill();
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  drawDepot(pen, x, y, color) {
    pen.fillStyle = color("ink");
    pen.strokeStyle = color("halo");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(x, y - 12);
    pen.lineTo(x + 11, y - 2);
    pen.lineTo(x + 8, y - 2);
    pen.lineTo(x + 8, y + 9);
    pen.lineTo(x - 8, y + 9);
    pen.lineTo(x - 8, y - 2);
    pen.lineTo(x - 11, y - 2);
    pen.closePath();
    pen.fill();
    pen.stroke();
  }

  drawGrid(pen, color, ink) {
    const step = nice(90 / this.scale),
      half = [this.width / 2 / this.scale, this.height / 2 / this.scale];
    pen.strokeStyle = color;
    pen.lineWidth = 1;
    pen.fillStyle = ink;
    pen.font = "10px system-ui, sans-serif";
    pen.textAlign = "left";
    pen.textBaseline = "top";
    const digits = Math.max(0, -Math.floor(Math.log10(step)));
    for (let x = Math.ceil((this.x - half[0]) / step) * step; x < this.x + half[0]; x += step) {
      const [px] = this.screen([x, 0]);
      line(pen, px, 0, px, this.height);
      pen.fillText((this.system === "plane" ? x : wrap(x)).toFixed(digits), px + 3, 3);
    }
    const [south] = this.userAt(0, this.height),
      north = this.userAt(0, 0);
    if (this.system === "plane") {
      for (let y = Math.ceil((this.y - half[1]) / step) * step; y < this.y + half[1]; y += step) {
        const py = this.screen([0, y])[1];
        line(pen, 0, py, this.width, py);
        if (py > 20) pen.fillText((-y || 0).toFixed(digits), 3, py + 2);
      }
    } else {
      for (let latitude = Math.ceil(south / step) * step; latitude < north[0]; latitude += step) {
        const py = this.screen(this.world([latitude, this.reference]))[1];
        line(pen, 0, py, this.width, py);
        if (py > 20) pen.fillText(latitude.toFixed(digits), 3, py + 2);
      }
    }
  }

  drawScale(pen, ink) {
    const latitude = this.system === "plane" ? 0 : this.userAt(this.width / 2, this.height / 2)[0];
    const perPixel =
      (this.system === "plane" ? this.metersPerUnit : 111319.49 * Math.cos((latitude * Math.PI) / 180)) / this.scale;
    const meters = nice(perPixel * 110),
      width = meters / perPixel,
      y = this.height - 14;
    pen.strokeStyle = ink;
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(12, y - 5);
    pen.lineTo(12, y);
    pen.lineTo(12 + width, y);
    pen.lineTo(12 + width, y - 5);
    pen.stroke();
    pen.fillStyle = ink;
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "left";
    pen.textBaseline = "bottom";
    pen.fillText(meters >= 1000 ? `${meters / 1000} km` : `${Number(meters.toPrecision(3))} m`, 16, y - 4);
  }
}

const wrap = (degrees) => ((((degrees + 180) % 360) + 360) % 360) - 180;
const nice = (least) => {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].find((one) => one * power >= least * 0.999) * power;
};
function span(points, axis) {
  let low = Infinity,
    high = -Infinity;
  for (const point of points) {
    low = Math.min(low, point[axis]);
    high = Math.max(high, point[axis]);
  }
  return [low, high];
}
function circle(pen, x, y, radius) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * Math.PI);
}
function line(pen, x, y, toX, toY) {
  pen.beginPath();
  pen.moveTo(x, y);
  pen.lineTo(toX, toY);
  pen.stroke();
}
function text(pen, label, x, y, color, size) {
  pen.fillStyle = color;
  pen.font = `600 ${size}px system-ui, sans-serif`;
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.fillText(label, x, y + 0.5);
}
function arrow(pen, [ax, ay], [bx, by]) {
  const length = Math.hypot(bx - ax, by - ay);
  if (length < 44) return;
  const [dx, dy] = [(bx - ax) / length, (by - ay) / length],
    [x, y] = [(ax + bx) / 2, (ay + by) / 2];
  pen.beginPath();
  pen.moveTo(x + dx * 7, y + dy * 7);
  pen.lineTo(x - dx * 4 - dy * 5, y - dy * 4 + dx * 5);
  pen.lineTo(x - dx * 4 + dy * 5, y - dy * 4 - dx * 5);
  pen.closePath();
  pen.fill();
}
function toSegment([px, py], [ax, ay], [bx, by]) {
  const [dx, dy] = [bx - ax, by - ay],
    square = dx * dx + dy * dy;
  const part = square ? Math.max(0, Math.min(1, ((px - ax) * dx + (py - ay) * dy) / square)) : 0;
  return Math.hypot(px - ax - part * dx, py - ay - part * dy);
}
