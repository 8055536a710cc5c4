// Renderer on a 2D canvas, for machines without WebGL: triangles filled by this script with a depth buffer, flat shading.

const css = (colour, alpha = 1) => `rgba(${colour.map((c) => Math.round(255 * c)).join(",")},${alpha})`;

function createCanvasRenderer(canvas) {
  const context = canvas.getContext("2d");
  // Putting a picture replaces what lies below; drawing another canvas blends with it.
  const sheet = document.createElement("canvas");

  function polygon(points, fill) {
    context.beginPath();
    for (const [x, y] of points) context.lineTo(x, y);
    context.closePath();
    context.fillStyle = fill;
    context.strokeStyle = fill;
    context.fill();
    // A line of the same colour hides the seams between neighbours.
    context.stroke();
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

  /** Colour as the four bytes of a picture element, in one little-endian word. */
  function shade(colour, normal, frame, tone) {
    const lit = Math.max(dot(normal, frame.light), 0);
    const bright = tone * (AMBIENT[0] + AMBIENT[1] * dot(normal, frame.up) + DIFFUSE * lit);
    const [red, green, blue] = colour.map((c) => Math.round(255 * Math.sqrt(Math.min(c * c * bright, 1))));
    return ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
  }

  /** Fills a triangle of screen points [x, y, nearness] where it is nearer than what `layer` holds. */
  function fillTriangle([a, b, c], word, { width, height, nearness, words }) {
    const area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    if (area === 0) return;
    const clamp = (value, limit) => Math.min(Math.max(value, 0), limit);
    const top = clamp(Math.ceil(Math.min(a[1], b[1], c[1]) - 0.5), height);
    const bottom = clamp(Math.ceil(Math.max(a[1], b[1], c[1]) - 0.5), height);
    const left = clamp(Math.ceil(Math.min(a[0], b[0], c[0]) - 0.5), width);
    const right = clamp(Math.ceil(Math.max(a[0], b[0], c[0]) - 0.5), width);
    for (let row = top; row < bottom; row++)
      for (let column = left; column < right; column++) {
        const [x, y] = [column + 0.5, row + 0.5];
        const shareC = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area;
        const shareB = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area;
        const shareA = 1 - shareB - shareC;
        if (shareA < 0 || shareB < 0 || shareC < 0) continue;
        const near = shareA * a[2] + shareB * b[2] + shareC * c[2];
        const place = row * width + column;
        if (near <= nearness[place]) continue;
        nearness[place] = near;
        words[place] = word;
      }
  }

  /** Draws solids over the canvas, each hidden by the nearer ones of the same call. */
  function drawSolids(items, frame) {
    if (!items.length) return;
    const { width, height } = canvas;
    const picture = new ImageData(width, height);
    const layer = { width, height, nearness: new Float32Array(width * height), words: new Uint32Array(picture.data.buffer) };
    for (const { mesh, matrix, colour } of items) {
      const world = mesh.points.map((point) => transform(matrix, point).slice(0, 3));
      const clip = world.map((point) => transform(frame.viewProjection, point));
      // One over the depth is linear on the screen, the depth is not.
      const screen = clip.map((corner) => [...toScreen(corner), 1 / corner[3]]);
      for (const triangle of mesh.triangles) {
        if (triangle.some((i) => clip[i][3] <= frame.near)) continue;
        const [a, b, c] = triangle.map((i) => world[i]);
        const normal = normalize(cross(subtract(b, a), subtract(c, a)));
        if (dot(normal, subtract(frame.eye, a)) <= 0) continue;
        const [x, y, z] = [0, 1, 2].map((axis) => triangle.reduce((sum, i) => sum + mesh.points[i][axis], 0));
        const tone = mesh.octants && x * y * z < 0 ? DARK_OCTANT : 1;
        fillTriangle(triangle.map((i) => screen[i]), shade(colour, normal, frame, tone), layer);
      }
    }
    sheet.width = width;
    sheet.height = height;
    sheet.getContext("2d").putImageData(picture, 0, 0);
    context.drawImage(sheet, 0, 0);
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
