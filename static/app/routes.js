// Which module draws which address. The server answers each address (PAGES in app/api/http/page_addresses.py; a test
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

/**
 * An entry of the menu: its address, its text, and the route of the API that the caller must be allowed to use.
 *
 * @typedef {{ href: string, text: import("./texts/index.js").TextKey, needs?: string }} Entry
 */

/** @type {{ text: import("./texts/index.js").TextKey, entries: Entry[] }[]} */
export const MENU = [
  {
    text: "menu.registry",
    entries: [
      { href: "/markers", text: "markers.title", needs: "GET /v1/markers" },
      { href: "/roads", text: "roads.title", needs: "GET /v1/roads" },
      { href: "/plans", text: "plans.title", needs: "GET /v1/plans" },
      { href: "/imports", text: "imports.title", needs: "GET /v1/imports" },
    ],
  },
  {
    text: "menu.studio",
    entries: [
      { href: "/studio/plates", text: "plates.title", needs: "POST /v1/plate-drafts" },
      { href: "/studio/magnets", text: "magnets.title", needs: "POST /v1/codebook-drafts" },
      { href: "/studio/cerpms", text: "cerpms.title", needs: "POST /v1/markers" },
    ],
  },
  {
    text: "menu.vehicles",
    entries: [
      { href: "/decode", text: "decode.title", needs: "POST /v1/decodes" },
      { href: "/decodes", text: "decodes.title", needs: "GET /v1/decodes" },
      { href: "/operations/vehicles", text: "vehicles.title", needs: "GET /v1/vehicles" },
    ],
  },
  {
    text: "operations.title",
    entries: [
      { href: "/operations/jobs", text: "jobs.title", needs: "GET /v1/jobs" },
      { href: "/operations/maintenance", text: "maintenance.title", needs: "GET /v1/maintenance" },
      { href: "/operations/reports", text: "reports.title", needs: "GET /v1/damage-reports" },
      { href: "/operations/codebooks", text: "codebooks.title", needs: "GET /v1/codebooks" },
      { href: "/operations/keys", text: "keys.title", needs: "GET /v1/keys" },
      { href: "/operations/webhooks", text: "webhooks.title", needs: "GET /v1/webhooks" },
      { href: "/operations/snapshots", text: "snapshots.title", needs: "GET /v1/snapshots" },
      { href: "/operations/reprocessings", text: "reprocessings.title", needs: "GET /v1/reprocessings" },
      { href: "/operations/audit", text: "audit.title", needs: "GET /v1/audit" },
      { href: "/operations/settings", text: "settings.title" },
    ],
  },
];
