"use strict";
(() => {
  const scene = JSON.parse(document.getElementById("viewer-data").textContent);
  const stage = document.getElementById("viewer");
  const element = (name) => document.getElementById(`viewer-${name}`);
  function numbers(text, Kind) {
    const bytes = atob(text);
    const values = new Uint8Array(bytes.length); // a loop: Uint8Array.from takes ten times as long
    for (let k = 0; k < bytes.length; k++) values[k] = bytes.charCodeAt(k);
    return new Kind(values.buffer);
  }

  // --- the data: millimetres and 0.1 ms in, metres and seconds out ---------------------------------------

  const MISSING = { 2: -32768, 4: -2147483648 };
  const time = Float64Array.from(numbers(scene.t, Int32Array), (t) => t / 1e4);
  const last = time.length - 1;
  const usual = last > 0 ? Array.from(time.subarray(1), (t, k) => t - time[k]).sort((a, b) => a - b)[last >> 1] : 1;
  const LONGEST_STEP = 2.5; // usual steps: nothing is drawn between times further apart
  const cameras = scene.cameras.map((camera) => ({
    ...camera,
    position: numbers(camera.position, Int32Array),
    rotation: numbers(camera.rotation, Int16Array),
  }));
  const body = scene.body && {
    ...scene.body,
    feet: numbers(scene.body.feet, Int32Array),
    middle: numbers(scene.body.middle, Int32Array),
    joint: numbers(scene.body.joint, Int16Array),
    truth: scene.body.truth && numbers(scene.body.truth, Int16Array),
    root: scene.body.root && numbers(scene.body.root, Int16Array),
  };
  const surface = scene.surface && { ...scene.surface, points: numbers(scene.surface.points, Int32Array) };
  const skin = scene.skin && {
    ...scene.skin,
    ...Object.fromEntries(["triangles", "bone", "weight"].map((name) => [name, numbers(scene.skin[name], Int16Array)])),
    bodies: scene.skin.bodies.map((each) => ({
      person: each.person,
      ...Object.fromEntries(["rest", "joints", "centre", "turn", "sigma"].map((name) => [name, numbers(each[name], Int16Array)])),
    })),
  };
  const people = body ? body.people : 0;
  const jointCount = body ? body.joints.length : 0;

  const known = (values, row) => values[3 * row] !== MISSING[values.BYTES_PER_ELEMENT];
  const triple = (values, row) => [values[3 * row] / 1e3, values[3 * row + 1] / 1e3, values[3 * row + 2] / 1e3];
  const mix = (a, b, f) => a.map((value, k) => value + f * (b[k] - value));
  const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

  /** The stored times around t. `near` is -1 where none is near enough to stand for it. */
  function bracket(t) {
    let low = 0;
    let high = last;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (time[middle] <= t) low = middle;
      else high = middle;
    }
    const step = time[high] - time[low];
    const fraction = step > 0 ? Math.min(Math.max((t - time[low]) / step, 0), 1) : 0;
    const near = fraction < 0.5 ? low : high;
    const bridged = step <= LONGEST_STEP * usual;
    return { low, high, fraction, bridged, near: bridged || Math.abs(t - time[near]) <= usual ? near : -1 };
  }

  /** What is known at the nearest time, moved towards the other one where that is known as well. */
  function between(at, row, isKnown, value, blend = mix) {
    if (at.near < 0 || !isKnown(row(at.near))) return null;
    const both = at.bridged && isKnown(row(at.low)) && isKnown(row(at.high));
    return both ? blend(value(row(at.low)), value(row(at.high)), at.fraction) : value(row(at.near));
  }

  function jointsAt(values, person, at) {
    const joints = [];
    for (let j = 0; j < jointCount; j++) {
      joints.push(
        between(
          at,
          (k) => (k * people + person) * jointCount + j,
          (row) => known(values, row),
          (row) => add(triple(values, row), triple(body.middle, Math.floor(row / jointCount))),
        ),
      );
    }
    for (const parents of body.derived) {
      const [a, b] = parents.map((parent) => joints[parent]);
      joints.push(a && b ? mix(a, b, 0.5) : null);
    }
    return joints;
  }

  const middleAt = (person, at) =>
    between(at, (k) => k * people + person, (row) => known(body.middle, row), (row) => triple(body.middle, row));

  const cameraPosition = (camera, at) =>
    between(at, (k) => k, (row) => known(camera.position, row), (row) => triple(camera.position, row));

  function turnedTowards(a, b, f) {
    const side = a.reduce((sum, value, k) => sum + value * b[k], 0) < 0 ? -1 : 1;
    const mixed = a.map((value, k) => (1 - f) * value + f * side * b[k]);
    const length = Math.hypot(...mixed);
    return mixed.map((value) => value / length);
  }

  const cameraRotation = (camera, at) =>
    between(
      at,
      (k) => k,
      (row) => known(camera.position, row),
      (row) => Array.from(camera.rotation.subarray(4 * row, 4 * row + 4), (value) => value / 32767),
      turnedTowards,
    );

  function rotate([x, y, z, w], v) {
    const t = [2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])];
    return [
      v[0] + w * t[0] + y * t[2] - z * t[1],
      v[1] + w * t[1] + z * t[0] - x * t[2],
      v[2] + w * t[2] + x * t[1] - y * t[0],
    ];
  }

  /** Where each person is, without the jitter of a median over changing joints: the mean of a second. */
  function steadyMiddles() {
    const half = Math.max(1, Math.round(0.5 / usual));
    return Array.from({ length: people }, (_, person) => {
      const sums = [[0, 0, 0, 0]];
      for (let k = 0; k <= last; k++) {
        const row = k * people + person;
        const there = known(body.middle, row);
        const point = there ? triple(body.middle, row) : [0, 0, 0];
        sums.push(sums[k].map((sum, axis) => sum + (axis < 3 ? point[axis] : Number(there))));
      }
      let held = null;
      const steady = Array.from(time, (_, k) => {
        const from = sums[Math.max(k - half, 0)];
        const to = sums[Math.min(k + half, last) + 1];
        const count = to[3] - from[3];
        held = count > 0 ? [0, 1, 2].map((axis) => (to[axis] - from[axis]) / count) : held;
        return held;
      });
      const first = steady.find((point) => point) || [0, 0, 0];
      return steady.map((point) => point || first);
    });
  }
  const steady = body ? steadyMiddles() : [];

  function steadyAt(person, at) {
    return mix(steady[person][at.low], steady[person][at.high], at.fraction);
  }

  // --- the two views: one pair of angles, a distance each ------------------------------------------------

  const HALF_HEIGHT = Math.tan(Math.PI / 180 * 16); // of the field of view, at distance 1
  const START = { azimuth: -1.0, elevation: 0.42 };
  const angles = { ...START };
  const lowest = [scene.low[0], scene.low[1], Math.min(scene.low[2], scene.ground)];
  const centre = mix(lowest, scene.high, 0.5);
  const extent = scene.high.map((value, k) => Math.max(value - centre[k], 1));
  const radius = Math.hypot(...extent);
  const views = [
    { canvas: element("flight"), whole: true },
    { canvas: element("body"), whole: false },
  ].filter((view) => view.canvas);
  for (const view of views) view.context = view.canvas.getContext("2d");
  const frustumDepth = Math.min(Math.max(0.09 * radius, 0.25), 5);

  let colours = {};
  function readColours() {
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    colours = {
      paper: colour("paper"), ink: colour("ink"), muted: colour("muted"), grid: colour("grid"),
      sides: [colour("middle"), colour("left"), colour("right")],
      people: Array.from({ length: people }, (_, p) => colour(people > 1 ? `person-${p % 6}` : "ink")),
      cameras: cameras.map((camera, k) => colour(`camera-${camera.colour ?? k % 6}`)),
      font: `11px ${style.getPropertyValue("--sans")}`,
    };
  }

  /** Right, up and forward of the eye, as rows. */
  function eyeAxes({ azimuth, elevation }) {
    const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
    return [[-sa, ca, 0], [-se * ca, -se * sa, ce], [-ce * ca, -ce * sa, -se]];
  }

  // The narrower side decides, so that a tall canvas shows as much as a wide one.
  const focalOf = ({ clientWidth, clientHeight }) => Math.min(clientHeight, 1.2 * clientWidth) / 2 / HALF_HEIGHT;

  /** The least distance from which the view shows all it is about, at the angles of the start. */
  function fit(view) {
    const [right, up, forward] = eyeAxes(START);
    const [width, height] = [view.canvas.clientWidth, view.canvas.clientHeight];
    const points = view.whole ? outline() : [[0, 0, 1.3], [0, 0, -1.3]]; // a body, and a little air around it
    return Math.max(...points.map((point) => {
      const aside = Math.max(Math.abs(dot(point, right)) / (0.44 * width), Math.abs(dot(point, up)) / (0.42 * height));
      return aside * focalOf(view.canvas) - dot(point, forward);
    }));
  }

  /** A hundred points of every path and what they stand over, from the centre, but for those gone astray. */
  function outline() {
    const points = [mix(centre, scene.high, 0.5)];
    for (let k = 0; k <= last; k += Math.ceil((last + 1) / 100)) {
      const there = cameras.filter((camera) => known(camera.position, k)).map((camera) => triple(camera.position, k));
      for (const point of [...there, ...steady.map((middles) => middles[k])]) points.push(point, onGround(point));
    }
    const fromCentre = points.map((point) => point.map((value, axis) => value - centre[axis]));
    return fromCentre.filter((point) => point.every((value, axis) => Math.abs(value) <= 1.2 * extent[axis]));
  }

  function looking(view, at) {
    const through = view.whole ? throughCamera(view, at) : null;
    if (through) return through;
    const { canvas, distance } = view;
    const target = view.whole || !people ? centre : steadyAt(person(), at);
    const ground = groundAt(at);
    const axes = eyeAxes(angles);
    const eye = target.map((value, k) => value - distance * axes[2][k]);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const focal = focalOf(canvas);
    const near = 0.02 * distance;
    const inside = (p) => {
      const q = [p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]];
      return axes.map((axis) => dot(q, axis));
    };
    const flat = (q) => [width / 2 + (focal * q[0]) / q[2], height / 2 - (focal * q[1]) / q[2]];
    return { target, ground, axes, width, height, focal, near, inside, flat, distance, context: view.context };
  }

  /** The flight as the chosen camera sees it, by its pinhole alone; null without a choice, or without its pose. */
  function throughCamera(view, at) {
    const [camera, c] = shownCameras().find((each) => String(each[1]) === (element("from")?.value ?? "")) ?? [];
    const eye = camera && cameraPosition(camera, at);
    if (!eye) return null;
    const rotation = cameraRotation(camera, at);
    const axes = [[1, 0, 0], [0, -1, 0], [0, 0, 1]].map((axis) => rotate(rotation, axis));
    const [left, right, top, bottom] = edgesOf(camera);
    const [width, height] = [view.canvas.clientWidth, view.canvas.clientHeight];
    const focal = 0.94 * Math.min(width / (right - left), height / (bottom - top));
    const inside = (p) => axes.map((axis) => dot(p.map((value, k) => value - eye[k]), axis));
    const place = (x, y) => [width / 2 + focal * (x - (left + right) / 2), height / 2 + focal * (y - (top + bottom) / 2)];
    const target = people ? steadyAt(person(), at) : onGround(eye);
    const distance = Math.max(Math.hypot(...target.map((value, k) => value - eye[k])), 0.5);
    const frame = [...place(left, top), focal * (right - left), focal * (bottom - top)];
    const flat = (q) => place(q[0] / q[2], -q[1] / q[2]);
    const ground = groundAt(at);
    return { target, ground, axes, width, height, focal, near: 0.05, inside, flat, distance, context: view.context, own: c, frame };
  }

  /** Left, right, upper and lower edge of a camera's picture, 1 m in front of it; those of a fisheye lens cut off. */
  const edgesOf = (camera) => camera.corners.map((edge) => Math.min(Math.max(edge, -1.2), 1.2));

  /** A straight line in space, cut off in front of the eye. */
  function line(eye, a, b) {
    let [p, q] = [eye.inside(a), eye.inside(b)];
    if (p[2] < eye.near && q[2] < eye.near) return;
    if (p[2] < eye.near) p = mix(q, p, (q[2] - eye.near) / (q[2] - p[2]));
    if (q[2] < eye.near) q = mix(p, q, (p[2] - eye.near) / (p[2] - q[2]));
    eye.context.moveTo(...eye.flat(p));
    eye.context.lineTo(...eye.flat(q));
  }

  function stroke(eye, style, draw) {
    const { context } = eye;
    context.save();
    Object.assign(context, { lineCap: "round", lineJoin: "round" }, style);
    context.setLineDash(style.dash || []);
    context.beginPath();
    draw();
    context.stroke();
    context.restore();
  }

  function dotAt(eye, point, size, colour) {
    const q = eye.inside(point);
    if (q[2] < eye.near) return;
    const { context } = eye;
    context.fillStyle = colour;
    context.beginPath();
    context.arc(...eye.flat(q), size, 0, 2 * Math.PI);
    context.fill();
  }

  function label(eye, text, x, y, colour, align = "center") {
    const { context } = eye;
    Object.assign(context, { font: colours.font, textAlign: align, lineJoin: "round", lineWidth: 3 });
    context.strokeStyle = colours.paper;
    context.strokeText(text, x, y);
    context.fillStyle = colour;
    context.fillText(text, x, y);
  }

  // --- what is drawn -------------------------------------------------------------------------------------

  function spacing(distance) {
    const least = distance / 14;
    const power = 10 ** Math.floor(Math.log10(least));
    return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= least);
  }

  const REACH = 16;
  const LEVELS = 6;
  /** The edges of the ground's squares by how far out they lie: each ring is drawn fainter. */
  const RINGS = Array.from({ length: LEVELS }, () => []);
  for (let i = -REACH; i <= REACH; i++) {
    for (let j = -REACH; j < REACH; j++) {
      const out = Math.hypot(i, j + 0.5) / REACH;
      if (out < 1) RINGS[Math.floor(LEVELS * Math.max(1.5 * out - 0.5, 0))].push([i, j]);
    }
  }

  function drawGround(eye) {
    const step = spacing(eye.distance);
    const snapped = [0, 1].map((axis) => Math.round(eye.target[axis] / step) * step);
    const at = (i, j) => [snapped[0] + i * step, snapped[1] + j * step, eye.ground];
    for (let level = 0; level < LEVELS; level++) {
      const style = { strokeStyle: colours.grid, lineWidth: 1, globalAlpha: 1 - level / LEVELS };
      stroke(eye, style, () => {
        for (const [i, j] of RINGS[level]) {
          line(eye, at(i, j), at(i, j + 1));
          line(eye, at(j, i), at(j + 1, i));
        }
      });
    }
    return step;
  }

  const PATH_POINTS = 1200;
  const TRAIL_S = 30; // of the path that is drawn stronger: more of a long flight would hide the rest

  /** A path between two times, broken where nothing is known. */
  function path(eye, since, until, pointAt) {
    const first = bracket(since).low;
    const end = time[last] <= until ? last : bracket(until).low;
    const stride = Math.max(1, Math.ceil((end - first + 1) / PATH_POINTS));
    let before = null;
    let beforeTime = 0;
    for (let k = first; k <= end; k += stride) {
      const point = pointAt(k);
      const whole = point && before && time[k] - beforeTime <= LONGEST_STEP * usual * stride;
      if (whole) line(eye, before, point);
      before = point;
      beforeTime = time[k];
    }
  }

  const onGround = (point, height = scene.ground) => [point[0], point[1], height];

  /** The height on which a person stands at a stored time. */
  const feetOf = (p, k) => body.feet[k * people + p] / 1e3;

  /** The height of the ground that is drawn: the one on which the chosen person stands. */
  const groundAt = (at) => (people ? mix([feetOf(person(), at.low)], [feetOf(person(), at.high)], at.fraction)[0] : scene.ground);

  function drawPaths(eye, at, t) {
    for (let p = 0; p < people; p++) {
      const pointAt = (k) => (known(body.middle, k * people + p) ? onGround(steady[p][k], feetOf(p, k)) : null);
      stroke(eye, { strokeStyle: colours.people[p], lineWidth: 1, globalAlpha: 0.3 }, () => path(eye, -Infinity, Infinity, pointAt));
      stroke(eye, { strokeStyle: colours.people[p], lineWidth: 1.8, globalAlpha: 0.8 }, () => path(eye, t - TRAIL_S, t, pointAt));
    }
    shownCameras().forEach(([camera, c]) => {
      const pointAt = (k) => (known(camera.position, k) ? triple(camera.position, k) : null);
      stroke(eye, { strokeStyle: colours.cameras[c], lineWidth: 1, globalAlpha: 0.35 }, () => path(eye, -Infinity, Infinity, pointAt));
      stroke(eye, { strokeStyle: colours.cameras[c], lineWidth: 1.6 }, () => path(eye, t - TRAIL_S, t, pointAt));
      const position = cameraPosition(camera, at);
      if (!position) return;
      stroke(eye, { strokeStyle: colours.cameras[c], lineWidth: 1, globalAlpha: 0.5, dash: [2, 3] }, () =>
        line(eye, position, onGround(position, eye.ground)),
      );
      dotAt(eye, onGround(position, eye.ground), 1.8, colours.cameras[c]);
    });
  }

  /** The cameras of the session, or those of a planner that flew again, each with its number. */
  function shownCameras() {
    const arm = element("arm")?.value ?? "";
    return cameras.map((camera, c) => [camera, c]).filter(([camera]) => String(camera.arm ?? "") === arm);
  }

  /** Offer the cameras that are shown as places to look from. */
  function offerCameras() {
    const options = shownCameras().map(([camera, c]) => new Option(camera.name, c));
    element("from").replaceChildren(new Option("outside", ""), ...options);
  }

  const cubes = surface
    ? Array.from({ length: surface.points.length / 3 }, (_, row) => triple(surface.points, row))
    : [];
  const highest = cubes.reduce((most, cube) => Math.max(most, cube[2]), scene.ground + 1);

  /** What the map holds: a square for each cube, the stronger the higher. */
  function drawSurface(eye) {
    const { context } = eye;
    context.save();
    context.fillStyle = colours.muted;
    for (const cube of cubes) {
      const q = eye.inside(cube);
      if (q[2] < eye.near) continue;
      const side = Math.max((0.7 * surface.cube * eye.focal) / q[2], 1);
      const [x, y] = eye.flat(q);
      const height = Math.max((cube[2] - scene.ground) / (highest - scene.ground), 0);
      context.globalAlpha = 0.12 + 0.4 * height;
      context.fillRect(x - side / 2, y - side / 2, side, side);
    }
    context.restore();
  }

  function cameraParts(eye, camera, c, at) {
    const position = cameraPosition(camera, at);
    if (!position) return [];
    const rotation = cameraRotation(camera, at);
    const [left, right, top, bottom] = edgesOf(camera);
    const corner = (x, y) => add(position, rotate(rotation, [x * frustumDepth, y * frustumDepth, frustumDepth]));
    const corners = [corner(left, top), corner(right, top), corner(right, bottom), corner(left, bottom)];
    const apex = eye.inside(position);
    const draw = () => {
      stroke(eye, { strokeStyle: colours.cameras[c], lineWidth: 1.2 }, () => {
        corners.forEach((end, k) => {
          line(eye, position, end);
          line(eye, end, corners[(k + 1) % 4]);
        });
      });
      // The upper edge tells which way the picture is up.
      stroke(eye, { strokeStyle: colours.cameras[c], lineWidth: 2.6 }, () => line(eye, corners[0], corners[1]));
      dotAt(eye, position, 2.4, colours.cameras[c]);
    };
    const tag = () => {
      if (apex[2] < eye.near) return;
      const [x, y] = eye.flat(apex);
      label(eye, camera.name, x, y - 8, colours.cameras[c]);
    };
    return [{ depth: apex[2], draw }, { depth: -1, draw: tag }];
  }

  const matrixOf = ([x, y, z, w]) => [
    1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
    2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
    2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
  ];

  /** The vertices of a person's surface at a stored time, each with its standard deviation in m; null without. */
  function skinAt({ person, rest, joints, centre, turn, sigma }, k) {
    const bones = joints.length / 3;
    if (k < 0 || !known(centre, k * bones) || !known(body.middle, k * people + person)) return null;
    const middle = triple(body.middle, k * people + person);
    const turns = Array.from({ length: bones }, (_, b) => Array.from(turn.subarray(4 * (k * bones + b), 4 * (k * bones + b) + 4)));
    const pivots = Array.from({ length: bones }, (_, b) => b);
    for (const [above, below] of skin.between) {
      turns.push(turnedTowards(turns[above], turns[below], 0.5));
      pivots.push(below);
    }
    // Bones between two others turn half as far, about the joint of the lower one (geometry/body_model.py).
    const parts = turns.map((each, b) => {
      const matrix = matrixOf(each.map((value) => value / Math.hypot(...each)));
      const [from, to] = [triple(joints, pivots[b]), triple(centre, k * bones + pivots[b])];
      const shift = [0, 1, 2].map((i) => middle[i] + to[i] - matrix[3 * i] * from[0] - matrix[3 * i + 1] * from[1] - matrix[3 * i + 2] * from[2]);
      return { matrix, shift, sigma: sigma[k * bones + pivots[b]] / 1e3 };
    });
    const shares = skin.bone.length / (rest.length / 3);
    return Array.from({ length: rest.length / 3 }, (_, v) => {
      const point = triple(rest, v);
      const found = [0, 0, 0, 0];
      let whole = 0;
      for (let s = shares * v; s < shares * (v + 1); s++) {
        const { matrix, shift, sigma: spread } = parts[skin.bone[s]];
        const weight = skin.weight[s];
        whole += weight;
        for (let i = 0; i < 3; i++) {
          found[i] += weight * (matrix[3 * i] * point[0] + matrix[3 * i + 1] * point[1] + matrix[3 * i + 2] * point[2] + shift[i]);
        }
        found[3] += weight * spread;
      }
      return found.map((value) => value / whole);
    });
  }

  const layer = document.createElement("canvas");

  /** Green below 1 cm, red from 30 cm on, in equal ratios. */
  const hueOf = (sigma) => 130 * (1 - Math.min(Math.max(Math.log(sigma / 0.01) / Math.log(30), 0), 1));

  /** Draw the sides of a surface that face the eye, far ones first; `place` gives x, y and depth of a vertex. */
  function drawSkin(context, vertices, place, alpha) {
    if (!context.canvas.width) return; // on a tab that is not shown
    const placed = vertices.map(place);
    const shownOnes = [];
    for (let f = 0; f < skin.triangles.length; f += 3) {
      const [i, j, k] = skin.triangles.subarray(f, f + 3);
      const [a, b, c] = [placed[i], placed[j], placed[k]];
      if (!a || !b || !c) continue;
      if ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) >= 0) continue;
      const [u, v] = [vertices[j], vertices[k]].map((other) => [0, 1, 2].map((axis) => other[axis] - vertices[i][axis]));
      const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      const light = normal[2] / (Math.hypot(...normal) || 1);
      shownOnes.push({ depth: a[2] + b[2] + c[2], corners: [a, b, c], light, sigma: vertices[i][3] });
    }
    shownOnes.sort((a, b) => b.depth - a.depth);
    // On a layer of its own: there triangles that overlap do not add up.
    layer.width = context.canvas.width;
    layer.height = context.canvas.height;
    const own = layer.getContext("2d");
    own.setTransform(context.getTransform());
    own.lineWidth = 0.7;
    for (const { corners, light, sigma } of shownOnes) {
      own.fillStyle = own.strokeStyle = `hsl(${hueOf(sigma)} 45% ${54 + 20 * light}%)`;
      own.beginPath();
      for (const [x, y] of corners) own.lineTo(x, y);
      own.closePath();
      own.fill();
      own.stroke(); // closes the hair lines between neighbours
    }
    context.save();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.globalAlpha = alpha;
    context.drawImage(layer, 0, 0);
    context.restore();
  }

  function drawSkins(eye, at) {
    const place = (vertex) => {
      const q = eye.inside(vertex);
      return q[2] < eye.near ? null : [...eye.flat(q), q[2]];
    };
    for (const each of skin.bodies) {
      const vertices = skinAt(each, at.near);
      if (vertices) drawSkin(eye.context, vertices, place, 0.75);
    }
  }

  const depthOf = (eye, a, b) => (eye.inside(a)[2] + eye.inside(b)[2]) / 2;

  function drawShadow(eye, joints, p, at) {
    const height = mix([feetOf(p, at.low)], [feetOf(p, at.high)], at.fraction)[0];
    const under = (joint) => onGround(joint, height);
    stroke(eye, { strokeStyle: colours.muted, lineWidth: 2, globalAlpha: 0.28 }, () => {
      for (const [a, b] of body.bones) if (joints[a] && joints[b]) line(eye, under(joints[a]), under(joints[b]));
    });
  }

  function boneParts(eye, joints, style) {
    const parts = [];
    for (const [a, b, side] of body.bones) {
      if (!joints[a] || !joints[b]) continue;
      const draw = () => stroke(eye, style(side), () => line(eye, joints[a], joints[b]));
      parts.push({ depth: depthOf(eye, joints[a], joints[b]), draw });
    }
    return parts;
  }

  /** A person's name above their highest joint. */
  function nameParts(eye, joints, p) {
    const top = joints.reduce((best, joint) => (joint && (!best || joint[2] > best[2]) ? joint : best), null);
    if (!top) return [];
    const above = [top[0], top[1], top[2] + 0.2];
    const q = eye.inside(above);
    if (q[2] < eye.near) return [];
    const draw = () => label(eye, body.names[p], ...eye.flat(q), colours.people[p]);
    return [{ depth: -1, draw }];
  }

  function jointParts(eye, joints, size) {
    return joints.slice(0, jointCount).flatMap((joint, j) => {
      if (!joint) return [];
      const draw = () => dotAt(eye, joint, size, colours.sides[body.sides[j]]);
      return [{ depth: eye.inside(joint)[2] - 0.01, draw }];
    });
  }

  const CHI2_95 = 7.815; // three degrees of freedom

  /** The outline of a 95 % ellipsoid {x : x' S^-1 x = 7.815}, in perspective to first order: S = L L'. */
  function ellipsoid(eye, joint, row, side) {
    const l = Array.from(body.root.subarray(6 * row, 6 * row + 6), (value) => value / 1e4);
    const q = eye.inside(joint);
    if (q[2] < eye.near) return;
    let [xx, xy, yy] = [0, 0, 0];
    for (const column of [[l[0], l[1], l[3]], [0, l[2], l[4]], [0, 0, l[5]]]) {
      const v = eye.axes.map((axis) => dot(column, axis));
      const dx = (eye.focal / q[2]) * (v[0] - (q[0] / q[2]) * v[2]);
      const dy = (-eye.focal / q[2]) * (v[1] - (q[1] / q[2]) * v[2]);
      xx += dx * dx;
      xy += dx * dy;
      yy += dy * dy;
    }
    const middle = (xx + yy) / 2;
    const spread = Math.hypot((xx - yy) / 2, xy);
    const radii = [middle + spread, Math.max(middle - spread, 0)].map((value) => Math.sqrt(CHI2_95 * value));
    const { context } = eye;
    context.save();
    context.beginPath();
    context.ellipse(...eye.flat(q), ...radii, Math.atan2(2 * xy, xx - yy) / 2, 0, 2 * Math.PI);
    Object.assign(context, { fillStyle: colours.sides[side], strokeStyle: colours.sides[side], globalAlpha: 0.04 });
    context.fill();
    context.globalAlpha = 0.4;
    context.lineWidth = 0.7;
    context.stroke();
    context.restore();
  }

  function ellipsoidParts(eye, joints, person, at) {
    return joints.slice(0, jointCount).flatMap((joint, j) => {
      const row = (at.near * people + person) * jointCount + j;
      if (!joint || body.root[6 * row] === MISSING[2]) return [];
      return [{ depth: eye.inside(joint)[2] + 0.01, draw: () => ellipsoid(eye, joint, row, body.sides[j]) }];
    });
  }

  /** East, north and up in the lower left corner, and how wide the squares of the ground are. */
  function drawCompass(eye, step) {
    const [x, y, length] = [30, eye.height - 34, 20];
    const axes = [["E", [1, 0, 0]], ["N", [0, 1, 0]], ["up", [0, 0, 1]]];
    for (const [name, axis] of axes) {
      const [dx, dy] = [dot(axis, eye.axes[0]), -dot(axis, eye.axes[1])];
      stroke(eye, { strokeStyle: colours.muted, lineWidth: 1.2 }, () => {
        eye.context.moveTo(x, y);
        eye.context.lineTo(x + length * dx, y + length * dy);
      });
      label(eye, name, x + 1.5 * length * dx, y + 1.5 * length * dy + 4, colours.muted);
    }
    const unit = step < 1 ? `${Math.round(step * 100)} cm` : `${step} m`;
    label(eye, `squares of ${unit}`, eye.width - 10, eye.height - 10, colours.muted, "right");
  }

  const shown = (name) => Boolean(element(name)?.checked);
  const person = () => Number(element("person")?.value ?? 0);

  function draw(view, at, t) {
    const eye = looking(view, at);
    const { context } = eye;
    const ratio = window.devicePixelRatio || 1;
    const size = [Math.round(eye.width * ratio), Math.round(eye.height * ratio)];
    if (view.canvas.width !== size[0]) view.canvas.width = size[0];
    if (view.canvas.height !== size[1]) view.canvas.height = size[1];
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, eye.width, eye.height);
    const step = drawGround(eye);
    if (view.whole && surface && shown("surface")) drawSurface(eye);
    if (shown("paths")) drawPaths(eye, at, t);
    const parts = [];
    const around = []; // ellipsoids lie behind all bodies, which would else be hidden
    // Bones as thick as 4 cm, but never lost from afar nor clumsy from near.
    const width = Math.min(Math.max((0.04 * eye.focal) / eye.distance, 1.6), 5);
    for (let p = 0; p < people; p++) {
      const joints = jointsAt(body.joint, p, at);
      drawShadow(eye, joints, p, at);
      // Of several people the bones have the person's colour, and the joints that of their side.
      const own = (side) => (people > 1 ? colours.people[p] : colours.sides[side]);
      parts.push(...boneParts(eye, joints, (side) => ({ strokeStyle: own(side), lineWidth: width })));
      if (people > 1) parts.push(...nameParts(eye, joints, p));
      parts.push(...jointParts(eye, joints, 0.75 * width + 0.4));
      if (body.root && shown("ellipsoids")) around.push(...ellipsoidParts(eye, joints, p, at));
      if (body.truth && shown("truth")) {
        const dash = width > 2.5 ? [4, 3.5] : [];
        const style = () => ({ strokeStyle: colours.ink, lineWidth: 1.1, globalAlpha: 0.85, dash, lineCap: "butt" });
        parts.push(...boneParts(eye, jointsAt(body.truth, p, at), style));
      }
    }
    shownCameras().forEach(([camera, c]) => c === eye.own || parts.push(...cameraParts(eye, camera, c, at)));
    parts.sort((a, b) => b.depth - a.depth);
    if (skin && shown("skin")) drawSkins(eye, at);
    for (const part of [...around, ...parts]) part.draw();
    if (eye.frame) {
      Object.assign(context, { strokeStyle: colours.cameras[eye.own], lineWidth: 1.2 });
      context.strokeRect(...eye.frame);
    }
    drawCompass(eye, step);
  }

  // --- time ----------------------------------------------------------------------------------------------

  const clock = { t: time[0], playing: false, before: 0 };
  const slider = element("time");
  const minus = (text) => text.replace("-", "\u2212");
  const seconds = (t) => `${minus(t.toFixed(2))}\u202fs`;

  function said(at) {
    const chosen = element("from").selectedOptions[0];
    const from = chosen?.value && cameras[Number(chosen.value)];
    if (from && !cameraPosition(from, at)) return `${from.name} has no pose at this time`;
    if (!people) return "";
    const joints = jointsAt(body.joint, person(), at);
    const measured = joints.slice(0, jointCount).filter((joint) => joint).length;
    const words = [`${measured} of ${jointCount} joints measured`];
    if (body.truth) {
      const truth = jointsAt(body.truth, person(), at);
      const errors = joints.slice(0, jointCount).flatMap((joint, j) =>
        joint && truth[j] ? [Math.hypot(...joint.map((value, k) => value - truth[j][k]))] : [],
      );
      const mean = errors.reduce((sum, error) => sum + error, 0) / errors.length;
      if (errors.length) words.push(`${(1000 * mean).toFixed(0)}\u202fmm from truth on average`);
    }
    return words.join(", ");
  }

  function show() {
    const at = bracket(clock.t);
    for (const view of views) draw(view, at, clock.t);
    for (const film of films) drawFilm(film, clock.t);
    slider.value = clock.t;
    slider.setAttribute("aria-valuetext", seconds(clock.t));
    element("now").textContent = seconds(clock.t);
    element("said").textContent = said(at);
    for (const curve of curves) curve.mark(clock.t);
  }

  // --- curves and pictures -------------------------------------------------------------------------------

  /** The drawings with a time axis: each shows the moment, and a click or an arrow key chooses it. */
  const curves = Array.from(document.querySelectorAll(".drawing[data-time]"), (drawing) => {
    const svg = drawing.querySelector("svg");
    const axes = svg.dataset.time.split(";").map((axis) => axis.split(" ").map(Number));
    const lines = axes.map(([, , , , top, bottom]) => {
      const line = document.createElementNS("http://www.w3.org/2000/svg", "line");
      line.setAttribute("class", "now");
      line.setAttribute("y1", top);
      line.setAttribute("y2", bottom);
      return svg.appendChild(line);
    });
    const placeOf = ([left, right, from, to], t) => left + ((t - from) / (to - from)) * (right - left);
    drawing.addEventListener("click", (event) => {
      const x = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse()).x;
      const axis = axes.find(([left, right]) => x >= left && x <= right);
      if (axis) choose(axis[2] + ((x - axis[0]) / (axis[1] - axis[0])) * (axis[3] - axis[2]));
    });
    drawing.addEventListener("keydown", (event) => {
      const count = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!count || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      step(event.shiftKey ? 10 * count : count);
      showNearestPictures(clock.t);
    });
    return {
      mark: (t) => axes.forEach((axis, k) => {
        const x = Math.min(Math.max(placeOf(axis, t), axis[0]), axis[1]);
        lines[k].setAttribute("x1", x);
        lines[k].setAttribute("x2", x);
      }),
    };
  });

  const moments = Array.from(document.querySelectorAll("input[name=moment]"), (input) => ({ input, t: Number(input.dataset.t) }));

  function showNearestPictures(t) {
    const far = (moment) => Math.abs(moment.t - t);
    if (moments.length) moments.reduce((best, moment) => (far(moment) < far(best) ? moment : best)).input.checked = true;
  }

  function choose(t) {
    play(false);
    seek(t);
    showNearestPictures(t);
  }

  function save(name, type, text) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type }));
    link.download = name;
    link.click();
    URL.revokeObjectURL(link.href);
  }

  /** Offer every table of the page but the folded ones as CSV: numbers as they are shown, with a plain minus. */
  for (const region of document.querySelectorAll(".table[aria-labelledby]")) {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: "Table (CSV)" });
    button.addEventListener("click", () => {
      const cell = (each) => {
        const words = Array.from(each.childNodes, (node) => node.textContent.replace(/\s+/g, " ").trim()).filter(Boolean);
        const text = words.join(", ").replace(/\u2212(?=\d)/g, "-");
        return `"${(/^[=+@\t]|^-(?!\d)/.test(text) ? `'${text}` : text).replace(/"/g, '""')}"`;
      };
      const rows = Array.from(region.querySelectorAll("tr"), (row) => Array.from(row.cells, cell).join(","));
      save(`${region.getAttribute("aria-labelledby").replace(/-caption$/, "")}.csv`, "text/csv", `${rows.join("\n")}\n`);
    });
    const downloads = document.createElement("div");
    downloads.className = "downloads";
    downloads.append(button);
    region.after(downloads);
  }

  /** Save a drawing with the colours of the page: outside of it, its variables have no values. */
  for (const button of document.querySelectorAll("button[data-save]")) {
    button.hidden = false;
    button.addEventListener("click", () => {
      const svg = button.closest("figure").querySelector("svg").cloneNode(true);
      for (const line of svg.querySelectorAll(".now")) line.remove();
      svg.setAttribute("xmlns", "http://www.w3.org/2000/svg");
      const style = getComputedStyle(document.documentElement);
      const text = svg.outerHTML.replace(/var\((--[\w-]+)\)/g, (_, name) => style.getPropertyValue(name).trim());
      save(button.dataset.save, "image/svg+xml", text);
    });
  }

  // --- the pictures of the cameras nearest to the moment -------------------------------------------------

  const ON_PICTURE = ["#dfe2e5", "#59b7f5", "#ff9d5c"]; // as over the still pictures of the page
  const films = (scene.film || []).map((film, k) => ({
    canvas: element(`film-${k}`),
    words: element(`film-time-${k}`),
    time: Float64Array.from(numbers(film.t, Int32Array), (t) => t / 1e4),
    joints: numbers(film.joints, Int16Array),
    projection: numbers(film.projection, Float32Array),
    images: film.pictures.map(() => null),
    pictures: film.pictures,
  }));
  const HELD = 60; // decoded pictures of a camera: a browser keeps no hour of them

  function imageOf(film, row) {
    if (!film.images[row]) {
      const image = new Image();
      image.addEventListener("load", showSoon);
      image.src = `data:image/webp;base64,${film.pictures[row]}`;
      film.images[row] = image;
      film.order = [...(film.order || []), row];
      if (film.order.length > HELD) film.images[film.order.shift()] = null;
    }
    return film.images[row];
  }

  function drawFilm(film, t) {
    let row = 0;
    for (let k = 1; k < film.time.length; k++) if (Math.abs(film.time[k] - t) < Math.abs(film.time[row] - t)) row = k;
    const { canvas } = film;
    const context = canvas.getContext("2d");
    const size = Math.round(canvas.clientWidth * (window.devicePixelRatio || 1));
    if (canvas.width !== size) canvas.width = canvas.height = size;
    context.clearRect(0, 0, size, size);
    const image = imageOf(film, row);
    if (image.complete && image.naturalWidth) context.drawImage(image, 0, 0, size, size);
    imageOf(film, Math.min(row + 1, film.time.length - 1));
    film.words.textContent = seconds(film.time[row]);
    if (skin && shown("skin")) {
      const p = film.projection.subarray(12 * row, 12 * row + 12);
      const place = (vertex) => {
        const [x, y, z] = [0, 4, 8].map((r) => p[r] * vertex[0] + p[r + 1] * vertex[1] + p[r + 2] * vertex[2] + p[r + 3]);
        return z > 0.05 ? [x / z * size, y / z * size, z] : null;
      };
      for (const each of skin.bodies) {
        const vertices = skinAt(each, bracket(film.time[row]).near);
        if (vertices) drawSkin(context, vertices, place, 0.5);
      }
    }
    const count = film.joints.length / 2 / film.time.length / people;
    for (let p = 0; p < people; p++) {
      const at = (j) => 2 * ((row * people + p) * count + j);
      for (const [a, b, side] of body.bones) {
        if (film.joints[at(a)] === MISSING[2] || film.joints[at(b)] === MISSING[2]) continue;
        context.beginPath();
        context.moveTo(...[0, 1].map((axis) => film.joints[at(a) + axis] / 1e4 * size));
        context.lineTo(...[0, 1].map((axis) => film.joints[at(b) + axis] / 1e4 * size));
        Object.assign(context, { strokeStyle: ON_PICTURE[side], lineWidth: size / 160, lineCap: "round" });
        context.stroke();
      }
    }
  }

  let asked = false;
  function showSoon() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      show();
    });
  }

  function seek(t) {
    clock.t = Math.min(Math.max(t, time[0]), time[last]);
    showSoon();
  }

  function play(playing) {
    clock.playing = playing;
    element("play").textContent = playing ? "Pause" : "Play";
    if (!playing) return;
    if (clock.t >= time[last]) clock.t = time[0];
    clock.before = performance.now();
    requestAnimationFrame(advance);
  }

  function advance(now) {
    if (!clock.playing) return;
    clock.t += Math.max(now - clock.before, 0) / 1000 * Number(element("speed").value);
    clock.before = now;
    if (clock.t >= time[last]) {
      clock.t = time[last];
      play(false);
    }
    show();
    if (clock.playing) requestAnimationFrame(advance);
  }

  function step(count) {
    play(false);
    seek(time[Math.min(Math.max(bracket(clock.t).near + count, 0), last)]);
  }

  // --- hands ---------------------------------------------------------------------------------------------

  /** Leave the camera that the flight is seen from. */
  function letGo() {
    if (element("from")) element("from").value = "";
  }

  function turn(view, azimuth, elevation) {
    if (view.whole) letGo();
    angles.azimuth += azimuth;
    angles.elevation = Math.min(Math.max(angles.elevation + elevation, -0.3), Math.PI / 2);
    showSoon();
  }

  function zoom(view, factor) {
    if (view.whole) letGo();
    view.distance = Math.min(Math.max(view.distance * factor, 0.15 * fit(view)), 40 * radius);
    showSoon();
  }

  function reset() {
    letGo();
    Object.assign(angles, START);
    for (const view of views) view.distance = fit(view);
    showSoon();
  }

  function fromAbove() {
    letGo();
    Object.assign(angles, { azimuth: -Math.PI / 2, elevation: Math.PI / 2 });
    showSoon();
  }

  /** One finger or the mouse turns; two fingers zoom, and tilt by moving up and down together. */
  function grab(view) {
    const { canvas } = view;
    const fingers = new Map();
    const spread = () => {
      const [a, b] = [...fingers.values()];
      return { size: Math.hypot(a.x - b.x, a.y - b.y), y: (a.y + b.y) / 2 };
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.focus({ preventScroll: true });
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const now = { x: event.clientX, y: event.clientY };
      const was = fingers.size === 2 ? spread() : null;
      fingers.set(event.pointerId, now);
      if (was) {
        const is = spread();
        zoom(view, was.size / Math.max(is.size, 1));
        turn(view, 0, (is.y - was.y) * 0.008);
      } else if (fingers.size === 1) {
        turn(view, (before.x - now.x) * 0.008, (now.y - before.y) * 0.008);
      }
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    }
    // Only the view that was chosen takes the wheel: elsewhere it scrolls the page.
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      zoom(view, Math.exp(0.0015 * Math.max(-300, Math.min(300, event.deltaY * (event.deltaMode ? 30 : 1)))));
    }, { passive: false });
    const keys = {
      ArrowLeft: () => turn(view, -0.1, 0), ArrowRight: () => turn(view, 0.1, 0),
      ArrowUp: () => turn(view, 0, 0.1), ArrowDown: () => turn(view, 0, -0.1),
      "+": () => zoom(view, 1 / 1.15), "=": () => zoom(view, 1 / 1.15), "-": () => zoom(view, 1.15),
      " ": () => play(!clock.playing), ",": () => step(-1), ".": () => step(1), "0": reset,
    };
    canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  /** #t=3.2 in the address, or in a link of the page, is a moment to show. */
  function momentIn(hash) {
    const found = /^#t=(-?\d+(?:\.\d+)?)$/.exec(hash);
    return found ? Number(found[1]) : null;
  }

  function goTo(hash) {
    const t = momentIn(hash);
    if (t === null) return;
    play(false);
    seek(t);
    stage.scrollIntoView({ block: "nearest" });
  }

  slider.min = time[0];
  slider.max = time[last];
  slider.step = last > 0 ? Math.max(Math.round(usual * 1e4) / 1e4, 1e-4) : 1;
  slider.addEventListener("input", () => {
    play(false);
    seek(Number(slider.value));
  });
  element("play").addEventListener("click", () => play(!clock.playing));
  element("reset").addEventListener("click", reset);
  element("above").addEventListener("click", fromAbove);
  for (const name of ["truth", "ellipsoids", "paths", "person", "arm", "surface", "skin", "from"]) element(name)?.addEventListener("change", showSoon);
  addEventListener("hashchange", () => goTo(location.hash));
  document.addEventListener("click", (event) => {
    const link = event.target.closest?.('a[href^="#t="]');
    // The address does not change by a second click on the same moment.
    if (link && link.hash === location.hash) goTo(link.hash);
  });
  element("arm")?.addEventListener("change", offerCameras);
  views.forEach(grab);
  const recolour = () => {
    readColours();
    show();
  };
  for (const media of ["(prefers-color-scheme: dark)", "print"]) matchMedia(media).addEventListener("change", recolour);
  addEventListener("beforeprint", recolour);
  addEventListener("afterprint", recolour);

  stage.hidden = false;
  offerCameras();
  readColours();
  reset();
  clock.t = time[body ? body.start : 0];
  goTo(location.hash);
  show();
  new ResizeObserver(showSoon).observe(stage);
  stage.dataset.ready = "true";
})();
