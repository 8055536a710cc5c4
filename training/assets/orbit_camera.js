// Camera that circles a point: drag turns, shift-drag or right-drag pans, wheel or pinch zooms.

// The controls cover the lower edge: the scene starts a little smaller and is shown a little higher.
const FIRST_ZOOM = 1.18;
const RAISED = 0.08;

function createOrbitCamera(data, canvas, changed) {
  const [right, up, front] = data.basis;
  const { view } = data;
  const camera = { anchor: view.target, pan: [0, 0, 0], yaw: 0, pitch: 0, distance: FIRST_ZOOM * view.distance };

  function reset() {
    const { direction } = view;
    camera.yaw = Math.atan2(dot(direction, right), dot(direction, front));
    camera.pitch = Math.asin(Math.min(Math.max(dot(direction, up), -1), 1));
    camera.distance = FIRST_ZOOM * view.distance;
    camera.pan = [0, 0, 0];
    changed();
  }

  const target = () => add(camera.anchor, camera.pan);

  function eye() {
    const level = add(scale(right, Math.sin(camera.yaw)), scale(front, Math.cos(camera.yaw)));
    const direction = add(scale(level, Math.cos(camera.pitch)), scale(up, Math.sin(camera.pitch)));
    return add(target(), scale(direction, camera.distance));
  }

  function turn(yaw, pitch) {
    camera.yaw += yaw;
    camera.pitch = Math.min(Math.max(camera.pitch + pitch, -1.55), 1.55);
    changed();
  }

  function zoom(factor) {
    camera.distance = Math.min(Math.max(camera.distance * factor, 0.05 * view.radius), 60 * view.radius);
    changed();
  }

  function pan(x, y) {
    const across = normalize(cross(up, subtract(eye(), target())));
    const above = cross(normalize(subtract(eye(), target())), across);
    const pixel = (2 * camera.distance * Math.tan(view.fieldOfView / 2)) / canvas.clientHeight;
    camera.pan = add(camera.pan, add(scale(across, -x * pixel), scale(above, y * pixel)));
    changed();
  }

  const pointers = new Map();
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const [x, y] = [event.clientX - last.x, event.clientY - last.y];
    const before = pointers.size === 2 ? spread() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) zoom(before / Math.max(spread(), 1));
    else if (event.shiftKey || event.buttons & 2) pan(x, y);
    else turn(-0.008 * x, 0.008 * y);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      // A line is about 16 pixels; browsers differ in the unit they report.
      zoom(Math.exp(0.0012 * event.deltaY * (event.deltaMode === 1 ? 16 : 1)));
    },
    { passive: false },
  );

  /** Matrices for an image of the given aspect; a tall window widens the view instead of cutting its sides. */
  function matrices(aspect) {
    const half = Math.atan(Math.tan(view.fieldOfView / 2) / Math.min(aspect, 1));
    const near = 0.02 * camera.distance;
    const projection = perspective(2 * half, aspect, near, camera.distance + 80 * view.radius);
    projection[9] = -RAISED;
    const world = lookAt(eye(), target(), up);
    return { eye: eye(), target: target(), near, viewProjection: multiply(projection, world) };
  }

  return { reset, turn, zoom, matrices, follow: (point) => (camera.anchor = point) };
}
