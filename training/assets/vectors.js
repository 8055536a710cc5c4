// Vectors are arrays of three numbers; matrices are 16 numbers, column by column, as WebGL takes them.

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const length = (a) => Math.hypot(a[0], a[1], a[2]);
const normalize = (a) => scale(a, 1 / (length(a) || 1));
const mix = (a, b, t) => a.map((value, i) => value + (b[i] - value) * t);

/** Two unit vectors at right angles to a unit vector and to each other. */
function tangents(normal) {
  const other = Math.abs(normal[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
  const first = normalize(subtract(other, scale(normal, dot(other, normal))));
  return [first, cross(normal, first)];
}

/** Matrix with the given images of the x, y and z axes and of the origin. */
function frameMatrix(x, y, z, origin) {
  return [...x, 0, ...y, 0, ...z, 0, ...origin, 1];
}

/** Rotation by a quaternion (w, x, y, z), then translation. */
function poseMatrix(position, [w, x, y, z]) {
  return frameMatrix(
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    position,
  );
}

/** Frame whose y axis is `along`, stretched: `width` across, `size` along. */
function alongMatrix(origin, along, width, size) {
  const [first, second] = tangents(along);
  return frameMatrix(scale(second, width), scale(along, size), scale(first, width), origin);
}

function multiply(a, b) {
  const product = new Array(16).fill(0);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) product[4 * column + row] += a[4 * k + row] * b[4 * column + k];
  return product;
}

/** Matrix times a point; four components. */
function transform(m, [x, y, z]) {
  return [0, 1, 2, 3].map((row) => m[row] * x + m[4 + row] * y + m[8 + row] * z + m[12 + row]);
}

/** Matrix times a direction (no translation). */
function rotate(m, [x, y, z]) {
  return [0, 1, 2].map((row) => m[row] * x + m[4 + row] * y + m[8 + row] * z);
}

/** Camera matrix: world to view, looking from `eye` to `target`. */
function lookAt(eye, target, up) {
  const back = normalize(subtract(eye, target));
  const right = normalize(cross(up, back));
  const above = cross(back, right);
  return [
    right[0], above[0], back[0], 0, right[1], above[1], back[1], 0, right[2], above[2], back[2], 0,
    -dot(right, eye), -dot(above, eye), -dot(back, eye), 1,
  ];
}

function perspective(fieldOfView, aspect, near, far) {
  const focal = 1 / Math.tan(fieldOfView / 2);
  return [
    focal / aspect, 0, 0, 0, 0, focal, 0, 0,
    0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0,
  ];
}

/** Projection along `light` onto the plane `normal . x = offset`. */
function shadowMatrix(normal, offset, light) {
  const steepness = dot(normal, light);
  const image = (axis) => subtract(axis, scale(light, dot(normal, axis) / steepness));
  return frameMatrix(image([1, 0, 0]), image([0, 1, 0]), image([0, 0, 1]), scale(light, offset / steepness));
}
