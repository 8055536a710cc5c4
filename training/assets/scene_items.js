// What is to be drawn at a time: solids, ground planes and contact marks, for either renderer.

const LIGHT = [0.45, 1, 0.55]; // along right, up and front
const FORCE_COLOUR = [0.93, 0.27, 0.22];
const NORMAL_COLOUR = [0.1, 0.66, 0.62];

// Linear brightness of a surface: AMBIENT[0] + AMBIENT[1] * (normal . up) + DIFFUSE * max(normal . light, 0).
const AMBIENT = [0.36, 0.12];
const DIFFUSE = 0.72;
const DARK_OCTANT = 0.6;
const SHADOW_STRENGTH = 0.26;

/** Where a part of a compound sits in its body; other shapes have no pose of their own. */
function placeInBody({ localPosition = [0, 0, 0], localOrientation = [1, 0, 0, 0] }) {
  return poseMatrix(localPosition, localOrientation);
}

function createScene(recording) {
  const { data } = recording;
  const [right, up, front] = data.basis;
  const { radius } = data.view;
  const light = normalize(add(add(scale(right, LIGHT[0]), scale(up, LIGHT[1])), scale(front, LIGHT[2])));
  const bounded = data.shapes
    .filter((shape) => shape.kind !== "plane")
    .map((shape) => ({ ...shape, mesh: MESHES[shape.kind](shape), place: placeInBody(shape) }));
  const ball = sphereMesh(1);
  const shaft = cylinderMesh(1, 0, 1);
  const head = coneMesh(1, 0, 1);
  for (const mesh of [ball, shaft, head]) mesh.octants = false;

  function solids(time) {
    return bounded.flatMap((shape) => {
      const pose = recording.pose(time, shape.body);
      if (!pose) return [];
      const matrix = multiply(poseMatrix(pose.position, pose.orientation), shape.place);
      return [{ mesh: shape.mesh, colour: shape.colour, matrix }];
    });
  }

  /** Planes, each as the piece around the point looked at. */
  function planes(target) {
    return data.shapes
      .filter((shape) => shape.kind === "plane")
      .map(({ normal, offset }) => {
        const [first, second] = tangents(normal);
        const origin = add(target, scale(normal, offset - dot(normal, target)));
        return { normal, offset, first, second, origin, extent: 14 * radius, cell: data.gridCell };
      });
  }

  function arrow(start, direction, size, width, colour) {
    const tip = Math.min(6 * width, 0.6 * size);
    const neck = add(start, scale(direction, size - tip));
    return [
      { mesh: shaft, colour, matrix: alongMatrix(start, direction, width, size - tip) },
      { mesh: head, colour, matrix: alongMatrix(neck, direction, 0.38 * tip, tip) },
    ];
  }

  /** Contact points as dots, their normals and, where known, their forces as arrows. Sizes follow the scene. */
  function marks(time) {
    const width = 0.007 * radius;
    return recording.contactsAt(time).flatMap(({ position, normal, force }) => {
      const size = length(force);
      const dots = [{ mesh: ball, colour: FORCE_COLOUR, matrix: alongMatrix(position, [0, 1, 0], 2.2 * width, 2.2 * width) }];
      const shown = [...dots, ...arrow(position, normalize(normal), 0.16 * radius, 0.7 * width, NORMAL_COLOUR)];
      if (size === 0) return shown;
      const reach = Math.min(0.55 * (size / recording.typicalForce), 1.1) * radius;
      return [...shown, ...arrow(position, normalize(force), reach, width, FORCE_COLOUR)];
    });
  }

  /** Mean of the bodies of usual size, or null. */
  function middle(time) {
    const poses = bounded
      .filter((shape) => shape.boundingRadius <= 2 * radius)
      .map((shape) => recording.pose(time, shape.body))
      .filter(Boolean);
    return poses.length ? scale(poses.reduce((sum, pose) => add(sum, pose.position), [0, 0, 0]), 1 / poses.length) : null;
  }

  return { light, up, solids, planes, marks, middle, radius };
}

