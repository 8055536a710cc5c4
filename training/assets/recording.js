// The embedded data: decoding, and the state at any time.

function decode(text, ArrayType) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  return new ArrayType(bytes.buffer);
}

function createRecording(data) {
  const position = decode(data.position, Float32Array);
  const orientation = decode(data.orientation, Float32Array);
  const duration = (data.frameCount - 1) * data.dt;

  function bodyAt(frame, body) {
    const row = frame * data.bodyCount + body;
    return {
      position: Array.from(position.subarray(3 * row, 3 * row + 3)),
      orientation: Array.from(orientation.subarray(4 * row, 4 * row + 4)),
    };
  }

  /** Pose of a body between two frames, or null where it is not finite. */
  function pose(time, body) {
    const exact = Math.min(Math.max(time / data.dt, 0), data.frameCount - 1);
    const frame = Math.floor(exact + 1e-6);
    const after = bodyAt(Math.min(frame + 1, data.frameCount - 1), body);
    const before = bodyAt(frame, body);
    if (![...before.position, ...before.orientation].every(Number.isFinite)) return null;
    const part = Math.max(exact - frame, 0);
    if (part === 0 || ![...after.position, ...after.orientation].every(Number.isFinite)) return before;
    // q and -q are the same rotation: go the short way.
    const same = before.orientation.reduce((sum, value, i) => sum + value * after.orientation[i], 0);
    const target = same < 0 ? after.orientation.map((value) => -value) : after.orientation;
    const turned = mix(before.orientation, target, part);
    const norm = Math.hypot(...turned);
    return {
      position: mix(before.position, after.position, part),
      orientation: turned.map((value) => value / norm),
    };
  }

  const contacts = data.contacts && {
    position: decode(data.contacts.position, Float32Array),
    normal: decode(data.contacts.normal, Float32Array),
    force: decode(data.contacts.force, Float32Array),
    start: [0],
  };
  if (contacts) for (const count of decode(data.contacts.count, Uint32Array)) contacts.start.push(contacts.start.at(-1) + count);

  const frameAt = (time) => Math.min(Math.floor(time / data.dt + 1e-6), data.frameCount - 1);

  /** Contacts of the frame shown last; they are not interpolated. */
  function contactsAt(time) {
    if (!contacts) return [];
    const frame = frameAt(time);
    const found = [];
    for (let row = contacts.start[frame]; row < contacts.start[frame + 1]; row++) {
      const vector = (array) => Array.from(array.subarray(3 * row, 3 * row + 3));
      found.push({ position: vector(contacts.position), normal: vector(contacts.normal), force: vector(contacts.force) });
    }
    return found;
  }

  /** Force [N] that few contacts exceed; it sets the length of the arrows. Zero without forces. */
  function typicalForce() {
    const sizes = [];
    for (let row = 0; contacts && row < contacts.force.length; row += 3) {
      const size = Math.hypot(contacts.force[row], contacts.force[row + 1], contacts.force[row + 2]);
      if (size > 0) sizes.push(size);
    }
    sizes.sort((a, b) => a - b);
    return sizes.length ? sizes[Math.floor(0.95 * (sizes.length - 1))] : 0;
  }

  return { data, duration, pose, frameAt, contactsAt, typicalForce: typicalForce() };
}
