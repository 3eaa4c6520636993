// The menu, by the groups that the home page shows as well.

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
