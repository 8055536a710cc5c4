// Triangle meshes in the body frame: { points, normals, triangles, octants }. Axis of round shapes: y.
// A new kind of shape is one entry of MESHES.

const ROUND_SEGMENTS = 32;

/**
 * Surface of revolution about y. `profile`: [radius, y, normal radius, normal y] from bottom to top; where the normal
 * jumps, the point stands there twice.
 */
function revolved(profile, octants) {
  const mesh = { points: [], normals: [], triangles: [], octants };
  for (const [radius, y, normalRadius, normalY] of profile)
    for (let segment = 0; segment <= ROUND_SEGMENTS; segment++) {
      const angle = (2 * Math.PI * segment) / ROUND_SEGMENTS;
      const [sine, cosine] = [Math.sin(angle), Math.cos(angle)];
      mesh.points.push([radius * sine, y, radius * cosine]);
      mesh.normals.push([normalRadius * sine, normalY, normalRadius * cosine]);
    }
  for (let ring = 0; ring + 1 < profile.length; ring++)
    for (let segment = 0; segment < ROUND_SEGMENTS; segment++) {
      const low = ring * (ROUND_SEGMENTS + 1) + segment;
      const high = low + ROUND_SEGMENTS + 1;
      mesh.triangles.push([low, low + 1, high + 1], [low, high + 1, high]);
    }
  return mesh;
}

/** Part of a circle's profile between two elevations, centred at height `y`. */
function arc(radius, y, from, to, steps) {
  return Array.from({ length: steps + 1 }, (_, step) => {
    const elevation = from + ((to - from) * step) / steps;
    const [sine, cosine] = [Math.sin(elevation), Math.cos(elevation)];
    return [radius * cosine, y + radius * sine, cosine, sine];
  });
}

function sphereMesh(radius) {
  return revolved(arc(radius, 0, -Math.PI / 2, Math.PI / 2, 16), true);
}

function capsuleMesh(radius, halfHeight) {
  const bottom = arc(radius, -halfHeight, -Math.PI / 2, 0, 8);
  // The ring at the middle gives the two tones of the octants a sharp edge.
  return revolved([...bottom, [radius, 0, 1, 0], ...arc(radius, halfHeight, 0, Math.PI / 2, 8)], true);
}

function cylinderMesh(radius, low, high) {
  return revolved(
    [[0, low, 0, -1], [radius, low, 0, -1], [radius, low, 1, 0], [radius, high, 1, 0], [radius, high, 0, 1], [0, high, 0, 1]],
    true,
  );
}

function coneMesh(radius, low, high) {
  const slope = Math.hypot(radius, high - low);
  const [across, along] = [(high - low) / slope, radius / slope];
  return revolved([[0, low, 0, -1], [radius, low, 0, -1], [radius, low, across, along], [0, high, across, along]], true);
}

function boxMesh([x, y, z]) {
  const mesh = { points: [], normals: [], triangles: [], octants: false };
  for (let axis = 0; axis < 3; axis++)
    for (const side of [-1, 1]) {
      const start = mesh.points.length;
      for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
        const corner = [];
        corner[axis] = side;
        corner[(axis + 1) % 3] = u * side;
        corner[(axis + 2) % 3] = v;
        mesh.points.push([corner[0] * x, corner[1] * y, corner[2] * z]);
        mesh.normals.push([0, 1, 2].map((i) => (i === axis ? side : 0)));
      }
      mesh.triangles.push([start, start + 1, start + 2], [start, start + 2, start + 3]);
    }
  return mesh;
}

/** Flat facets of a solid: the corners of each triangle are its own, so that edges show. */
function facetMesh(points, triangles) {
  const mesh = { points: [], normals: [], triangles: [], octants: false };
  for (const [a, b, c] of triangles.map((corners) => corners.map((corner) => points[corner]))) {
    const start = mesh.points.length;
    const normal = normalize(cross(subtract(b, a), subtract(c, a)));
    mesh.points.push(a, b, c);
    mesh.normals.push(normal, normal, normal);
    mesh.triangles.push([start, start + 1, start + 2]);
  }
  return mesh;
}

/** Surface over a grid centred at the origin: rows along x, columns along z, cells cut from (i, j) to (i + 1, j + 1). */
function heightfieldMesh(heights, cellSize) {
  const [rows, columns] = [heights.length, heights[0].length];
  const points = heights.flatMap((row, i) =>
    row.map((height, j) => [(i - (rows - 1) / 2) * cellSize, height, (j - (columns - 1) / 2) * cellSize]),
  );
  const triangles = [];
  for (let i = 0; i + 1 < rows; i++)
    for (let j = 0; j + 1 < columns; j++) {
      const corner = i * columns + j;
      triangles.push([corner, corner + 1, corner + columns + 1], [corner, corner + columns + 1, corner + columns]);
    }
  return facetMesh(points, triangles);
}

const MESHES = {
  sphere: (shape) => sphereMesh(shape.radius),
  box: (shape) => boxMesh(shape.halfExtents),
  capsule: (shape) => capsuleMesh(shape.radius, shape.halfHeight),
  cylinder: (shape) => cylinderMesh(shape.radius, -shape.halfHeight, shape.halfHeight),
  // The origin of a cone is its centroid, a quarter of the height above the base.
  cone: (shape) => coneMesh(shape.radius, -0.5 * shape.halfHeight, 1.5 * shape.halfHeight),
  polyhedron: (shape) => facetMesh(shape.vertices, shape.triangles),
  heightfield: (shape) => heightfieldMesh(shape.heights, shape.cellSize),
};
