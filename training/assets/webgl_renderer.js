// Renderer on WebGL 2: depth-buffered solids, shadows on planes by projection, a grid that fades out.

const SOLID_VERTEX = `#version 300 es
layout(location = 0) in vec3 point;
layout(location = 1) in vec3 normal;
uniform mat4 model, viewProjection;
out vec3 local, turned, world;
void main() {
  local = point;
  turned = mat3(model) * normal;
  vec4 placed = model * vec4(point, 1.0);
  world = placed.xyz;
  gl_Position = viewProjection * placed;
}`;

const SOLID_FRAGMENT = `#version 300 es
precision highp float;
in vec3 local, turned, world;
uniform vec3 colour, light, up;
uniform float octants;
out vec4 pixel;
void main() {
  vec3 normal = normalize(turned);
  float tone = octants > 0.5 && local.x * local.y * local.z < 0.0 ? ${DARK_OCTANT.toFixed(3)} : 1.0;
  float bright = ${AMBIENT[0].toFixed(3)} + ${AMBIENT[1].toFixed(3)} * dot(normal, up)
    + ${DIFFUSE.toFixed(3)} * max(dot(normal, light), 0.0);
  pixel = vec4(sqrt(clamp(colour * colour * tone * bright, 0.0, 1.0)), 1.0);
}`;

const SHADOW_FRAGMENT = `#version 300 es
precision highp float;
in vec3 local, turned, world;
uniform vec3 centre;
uniform float extent;
out vec4 pixel;
void main() {
  pixel = vec4(0.0, 0.0, 0.0, ${SHADOW_STRENGTH.toFixed(3)} * (1.0 - smoothstep(0.3, 1.0, distance(world, centre) / extent)));
}`;

const GROUND_VERTEX = `#version 300 es
layout(location = 0) in vec3 point;
uniform mat4 viewProjection;
uniform vec3 origin, first, second;
uniform float extent;
uniform vec2 shift;
out vec2 across;
void main() {
  vec3 world = origin + extent * (point.x * first + point.y * second);
  across = shift + extent * point.xy;
  gl_Position = viewProjection * vec4(world, 1.0);
}`;

const GROUND_FRAGMENT = `#version 300 es
precision highp float;
in vec2 across;
uniform vec2 shift;
uniform vec3 fill, line;
uniform float extent, cell, solidity;
out vec4 pixel;
float lines(vec2 position, float width) {
  vec2 blur = max(fwidth(position), vec2(1e-6));
  vec2 away = abs(fract(position - 0.5) - 0.5) / blur;
  vec2 cover = clamp(width - away, 0.0, 1.0) * clamp(0.6 / blur - 0.6, 0.0, 1.0);
  return max(cover.x, cover.y);
}
void main() {
  float fade = 1.0 - smoothstep(0.3, 1.0, distance(across, shift) / extent);
  float drawn = max(0.55 * lines(across / cell, 1.1), lines(across / (4.0 * cell), 1.6));
  pixel = vec4(mix(fill, line, drawn), fade * mix(drawn, 1.0, solidity));
}`;

function compiled(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const places = {};
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(program, i);
    places[name] = gl.getUniformLocation(program, name);
  }
  return { program, places };
}

/** Renderer, or null where the browser has no WebGL 2. */
function createWebglRenderer(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: true, stencil: true, alpha: false });
  if (!gl) return null;
  const solid = compiled(gl, SOLID_VERTEX, SOLID_FRAGMENT);
  const shadow = compiled(gl, SOLID_VERTEX, SHADOW_FRAGMENT);
  const ground = compiled(gl, GROUND_VERTEX, GROUND_FRAGMENT);
  const buffers = new Map();

  function buffer(mesh) {
    if (!buffers.has(mesh)) {
      const array = gl.createVertexArray();
      gl.bindVertexArray(array);
      for (const [place, vectors] of [mesh.points, mesh.normals].entries()) {
        gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
        gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vectors.flat()), gl.STATIC_DRAW);
        gl.enableVertexAttribArray(place);
        gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
      }
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      const triangles = new Uint16Array(mesh.triangles.flat());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
      buffers.set(mesh, { array, count: triangles.length });
    }
    return buffers.get(mesh);
  }

  const square = {
    points: [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]],
    normals: [[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1]],
    triangles: [[0, 1, 2], [0, 2, 3]],
  };

  function drawMesh(mesh) {
    const { array, count } = buffer(mesh);
    gl.bindVertexArray(array);
    gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_SHORT, 0);
  }

  function use({ program, places }, values) {
    gl.useProgram(program);
    for (const [name, value] of Object.entries(values)) {
      if (typeof value === "number") gl.uniform1f(places[name], value);
      else if (value.length === 16) gl.uniformMatrix4fv(places[name], false, value);
      else gl[`uniform${value.length}fv`](places[name], value);
    }
  }

  function drawSolids(items, frame) {
    for (const { mesh, matrix, colour } of items) {
      const { viewProjection, light, up } = frame;
      use(solid, { model: matrix, viewProjection, colour, light, up, octants: mesh.octants ? 1 : 0 });
      drawMesh(mesh);
    }
  }

  function drawPlane(plane, frame) {
    const { normal, offset, origin, first, second, extent, cell } = plane;
    const { viewProjection, theme, eye, light } = frame;
    const outside = dot(normal, eye) > offset;
    const shift = [dot(origin, first), dot(origin, second)];
    const solidity = outside ? 1 : 0;
    gl.enable(gl.BLEND);
    gl.depthMask(outside);
    const { ground: fill, line } = theme;
    use(ground, { viewProjection, origin, first, second, extent, cell, shift, fill, line, solidity });
    drawMesh(square);
    gl.depthMask(false);
    if (outside && dot(normal, light) > 0.15) {
      // The stencil darkens a pixel once, however many shadows overlap there.
      gl.clear(gl.STENCIL_BUFFER_BIT);
      gl.enable(gl.STENCIL_TEST);
      gl.stencilFunc(gl.EQUAL, 0, 0xff);
      gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
      gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.polygonOffset(-2, -4);
      const projected = shadowMatrix(normal, offset, light);
      for (const { mesh, matrix } of frame.solids) {
        use(shadow, { model: multiply(projected, matrix), viewProjection, centre: origin, extent });
        drawMesh(mesh);
      }
      gl.disable(gl.POLYGON_OFFSET_FILL);
      gl.disable(gl.STENCIL_TEST);
    }
    gl.depthMask(true);
    gl.disable(gl.BLEND);
  }

  function draw(frame) {
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...frame.theme.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    drawSolids(frame.solids, frame);
    for (const plane of frame.planes) drawPlane(plane, frame);
    // Contacts lie between or inside bodies, so they are drawn over everything.
    gl.clear(gl.DEPTH_BUFFER_BIT);
    drawSolids(frame.marks, frame);
  }

  return { name: "webgl", draw };
}
