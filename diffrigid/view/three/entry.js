// What the 3D player uses of three.js, bundled into three.min.js by the command in package.json.
export {
  ArrowHelper, BoxGeometry, BufferGeometry, CapsuleGeometry, Color, DirectionalLight, DoubleSide,
  EdgesGeometry, Float32BufferAttribute, Fog, Group, HemisphereLight, Line, LineBasicMaterial, LineSegments,
  Mesh, MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, PlaneGeometry,
  Quaternion, Scene, SphereGeometry, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
