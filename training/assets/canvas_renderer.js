// Renderer on a 2D canvas, for machines without WebGL: triangles from far to near, flat shading.

const css = (colour, alpha = 1) => `rgba(${colour.map((c) => Math.round(255 * c)).join(",")},${alpha})`;

function createCanvasRenderer(canvas) {
  const context = canvas.getContext("2d");

  function polygon(points, fill, edge = fill) {
    context.beginPath();
    for (const [x, y] of points) context.lineTo(x, y);
    context.closePath();
    context.fillStyle = fill;
    context.strokeStyle = edge;
    context.fill();
    // A line of the same colour hides the seams between neighbours.
    if (edge) context.stroke();
  }

  const toScreen = ([x, y, , w]) => [(0.5 + (0.5 * x) / w) * canvas.width, (0.5 - (0.5 * y) / w) * canvas.height];

  /** The part of a polygon (in clip coordinates) before the camera. */
  function clipped(corners, near) {
    return corners.flatMap((corner, i) => {
      const next = corners[(i + 1) % corners.length];
      const kept = corner[3] > near ? [corner] : [];
      if (corner[3] > near === next[3] > near) return kept;
      return [...kept, mix(corner, next, (near - corner[3]) / (next[3] - corner[3]))];
    });
  }

  function shade(colour, normal, frame, tone) {
    const lit = Math.max(dot(normal, frame.light), 0);
    const bright = tone * (AMBIENT[0] + AMBIENT[1] * dot(normal, frame.up) + DIFFUSE * lit);
    return css(colour.map((c) => Math.sqrt(Math.min(c * c * bright, 1))));
  }

  function drawSolids(items, frame) {
    const faces = [];
    for (const { mesh, matrix, colour } of items) {
      const world = mesh.points.map((point) => transform(matrix, point).slice(0, 3));
      const screen = world.map((point) => transform(frame.viewProjection, point));
      for (const triangle of mesh.triangles) {
        const corners = triangle.map((i) => screen[i]);
        if (corners.some((corner) => corner[3] <= frame.near)) continue;
        const [a, b, c] = triangle.map((i) => world[i]);
        const normal = normalize(cross(subtract(b, a), subtract(c, a)));
        if (dot(normal, subtract(frame.eye, a)) <= 0) continue;
        const [x, y, z] = [0, 1, 2].map((axis) => triangle.reduce((sum, i) => sum + mesh.points[i][axis], 0));
        const tone = mesh.octants && x * y * z < 0 ? DARK_OCTANT : 1;
        const depth = corners[0][3] + corners[1][3] + corners[2][3];
        faces.push({ depth, points: corners.map(toScreen), fill: shade(colour, normal, frame, tone) });
      }
    }
    faces.sort((p, q) => q.depth - p.depth);
    for (const face of faces) polygon(face.points, face.fill);
  }

  function drawPlane(plane, frame) {
    const { normal, offset, origin, first, second, extent, cell } = plane;
    const at = (a, b) => add(origin, add(scale(first, a), scale(second, b)));
    const project = (points) => clipped(points.map((point) => transform(frame.viewProjection, point)), frame.near);
    const outside = dot(normal, frame.eye) > offset;
    const { ground, line } = frame.theme;
    if (outside) {
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => at(a * extent, b * extent));
      polygon(project(corners).map(toScreen), css(ground));
    }
    const shift = [dot(origin, first), dot(origin, second)];
    const count = Math.min(Math.floor(extent / cell), 60);
    context.strokeStyle = css(line, 0.6);
    for (let i = -count; i <= count; i++)
      for (const axis of [0, 1]) {
        const fixed = (Math.round(shift[axis] / cell) + i) * cell - shift[axis];
        const ends = [-extent, extent].map((free) => (axis ? at(free, fixed) : at(fixed, free)));
        const [from, to] = project(ends).map(toScreen);
        if (!to) continue;
        context.beginPath();
        context.moveTo(...from);
        context.lineTo(...to);
        context.stroke();
      }
    if (outside && dot(normal, frame.light) > 0.15) drawShadows(plane, frame);
  }

  function drawShadows({ normal, offset }, frame) {
    const projected = shadowMatrix(normal, offset, frame.light);
    const fill = css(frame.theme.ground.map((c) => c * (1 - SHADOW_STRENGTH)));
    for (const { mesh, matrix } of frame.solids) {
      const whole = multiply(frame.viewProjection, multiply(projected, matrix));
      const screen = mesh.points.map((point) => transform(whole, point));
      for (const triangle of mesh.triangles) {
        const corners = triangle.map((i) => screen[i]);
        if (corners.every((corner) => corner[3] > frame.near)) polygon(corners.map(toScreen), fill);
      }
    }
  }

  function draw(frame) {
    context.fillStyle = css(frame.theme.background);
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.lineWidth = 1;
    context.lineJoin = "round";
    for (const plane of frame.planes) drawPlane(plane, frame);
    drawSolids(frame.solids, frame);
    drawSolids(frame.marks, frame);
  }

  return { name: "canvas", draw };
}
