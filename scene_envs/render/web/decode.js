// The embedded data: base64 arrays to geometry and objects.

function bytes(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
}

// One mesh: quantised positions (0..65535 of its box), normals (-127..127), colors (0..255), triangle corners.
function decodeVisual(mesh) {
  const position = new Uint16Array(bytes(mesh.position));
  const corners = bytes(mesh.index);
  return {
    low: mesh.low,
    size: mesh.size,
    position,
    normal: new Int8Array(bytes(mesh.normal)),
    color: new Uint8Array(bytes(mesh.color)),
    index: position.length / 3 > 65535 ? new Uint32Array(corners) : new Uint16Array(corners),
  };
}

// Convex parts as one mesh with flat faces, each part in a tint of its own.
function decodeParts(parts, tint) {
  const corners = new Uint16Array(bytes(parts.position));
  const index = new Uint16Array(bytes(parts.index));
  const [position, normal, color] = [new Uint16Array(3 * index.length), new Int8Array(3 * index.length), []];
  const corner = (k) => [0, 1, 2].map((axis) => corners[3 * index[k] + axis]);
  const metres = (k) => corner(k).map((value, axis) => (value * parts.size[axis]) / 65535);
  for (let k = 0; k < index.length; k += 3) {
    const [a, b, c] = [metres(k), metres(k + 1), metres(k + 2)];
    const across = cross(subtract(b, a), subtract(c, a));
    const facing = Math.hypot(...across) > 0 ? unit(across) : [0, 0, 1];
    for (let i = 0; i < 3; i++) {
      position.set(corner(k + i), 3 * (k + i));
      normal.set(facing.map((value) => Math.round(127 * value)), 3 * (k + i));
    }
  }
  parts.faces.forEach((faces, part) => {
    const shade = partColor(tint, part);
    for (let k = 0; k < 3 * faces; k++) color.push(...shade);
  });
  const order = Uint32Array.from(index, (_, k) => k);
  return { low: parts.low, size: parts.size, position, normal, color: Uint8Array.from(color), index: order };
}

// The color of an asset, lighter or darker and turned a little, so that neighbouring parts differ.
function partColor(tint, part) {
  const turn = 2 * Math.PI * ((part * 0.618) % 1);
  const lift = part === 0 ? 0 : 34 * Math.sin(turn);
  return tint.map((value, channel) => clamp(Math.round(value + lift + 22 * Math.sin(turn + 2.1 * channel)), 0, 255));
}

// The objects of a scene: asset (index into data.assets), slot, translation (m) and quaternion (w, x, y, z).
function decodeScene(scene) {
  const assets = new Uint16Array(bytes(scene.assets));
  const slots = new Uint16Array(bytes(scene.slots));
  const poses = new Float32Array(bytes(scene.poses));
  return Array.from(assets, (asset, i) => ({
    asset,
    slot: slots[i],
    translation: Array.from(poses.subarray(7 * i, 7 * i + 3)),
    quaternion: Array.from(poses.subarray(7 * i + 3, 7 * i + 7)),
  }));
}
