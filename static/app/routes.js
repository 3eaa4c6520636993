// Which module draws which address. The server answers each address (PAGES in app/api/http/ui.py; a test
// compares the two), the module is loaded when it is needed. How to add a page: docs/web-pages.md.

/**
 * A page.
 *
 * @typedef {object} Route
 * @property {string} pattern Its address; a part that begins with a colon is a parameter.
 * @property {import("./texts/index.js").TextKey} title
 * @property {() => Promise<{ default: import("preact").ComponentType<any> }>} load
 * @property {boolean} [wide] It fills the window and scrolls inside.
 * @property {boolean} [open] It is shown to people who have not signed in.
 */

const markers = () => import("./pages/markers.js");
const decode = () => import("./pages/decode.js");
const imports = () => import("./pages/imports.js");
const operations = () => import("./pages/operations.js");
const vehicles = () => import("./pages/vehicles.js");

/** @type {Route[]} */
export const ROUTES = [
  { pattern: "/", title: "home.title", load: () => import("./pages/home.js") },
  { pattern: "/markers", title: "markers.title", load: markers, wide: true },
  { pattern: "/markers/:marker_id", title: "markers.title", load: markers, wide: true },
  { pattern: "/roads", title: "roads.title", load: () => import("./pages/roads.js") },
  { pattern: "/roads/new", title: "roads.new", load: () => import("./pages/roads_new.js") },
  { pattern: "/roads/:road_id", title: "roads.title", load: () => import("./pages/roads_road.js") },
  { pattern: "/roads/lanes/:alignment_id", title: "roads.title", load: () => import("./pages/roads_lanes.js") },
  { pattern: "/plans", title: "plans.title", load: () => import("./pages/plans.js") },
  { pattern: "/plans/new", title: "plans.new", load: () => import("./pages/plans_new.js") },
  { pattern: "/plans/compare", title: "compare.title", load: () => import("./pages/plans_compare.js") },
  { pattern: "/plans/:plan_id", title: "plans.title", load: () => import("./pages/plans_plan.js") },
  { pattern: "/decode", title: "decode.title", load: decode },
  { pattern: "/decodes", title: "decodes.title", load: () => import("./pages/decode_history.js") },
  { pattern: "/decodes/:decode_id", title: "decodes.title", load: decode },
  { pattern: "/studio/plates", title: "plates.title", load: () => import("./pages/studio_plates.js") },
  { pattern: "/studio/magnets", title: "magnets.title", load: () => import("./pages/studio_magnets.js") },
  { pattern: "/studio/cerpms", title: "cerpms.title", load: () => import("./pages/studio_cerpms.js") },
  { pattern: "/imports", title: "imports.title", load: imports },
  { pattern: "/imports/:import_id", title: "imports.title", load: imports },
  { pattern: "/operations/vehicles", title: "vehicles.title", load: vehicles },
  { pattern: "/operations/vehicles/:item_id", title: "vehicles.title", load: vehicles },
  { pattern: "/operations/:section", title: "operations.title", load: operations },
  { pattern: "/operations/:section/:item_id", title: "operations.title", load: operations },
  { pattern: "/sign-in", title: "signin.title", load: () => import("./pages/sign_in.js"), open: true },
];
