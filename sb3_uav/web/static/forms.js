import { $ } from "./tools.js";

// What the form says, with sentences instead of numbers that are none.
export function field(name, what, isOptional = false) {
  const input = $(name),
    value = input.valueAsNumber;
  if (Number.isNaN(value)) {
    if (isOptional && !input.validity.badInput) return null;
    input.focus();
    throw new Error(`${what} is missing.`);
  }
  return value;
}

// The fleet as the API takes it: the UAVs of the table, or equal ones.
export function fleet(uavs) {
  if (uavs) return { uavs };
  return {
    count: field("count", "The number of UAVs"),
    range_m: field("range", "The range") * ($("range-unit").value === "km" ? 1000 : 1),
    speed_mps: field("speed", "The speed", true),
    reserve_percent: field("reserve", "The reserve"),
  };
}

// Tasks to play with, the same every time.
export function exampleTasks() {
  let seed = 7;
  const random = () => {
    seed = (seed * 16807) % 2147483647;
    return seed / 2147483647;
  };
  const tasks = Array.from({ length: 80 }, (_, index) => ({
    id: `t${index + 1}`,
    point: [Math.round(random() * 9000), Math.round(random() * 6000)],
    value: 1 + Math.floor(random() * 5),
    service_s: 0,
    must: index % 20 === 3,
    altitude_m: null,
    forbidden: false,
  }));
  return { system: "plane", meters_per_unit: 1, depot: [4500, 3000], source: "example", tasks };
}
