// The API's reference, drawn by Redoc from this server's OpenAPI document.
Redoc.init(
  "/openapi.json",
  { disableSearch: true, hideLoading: true }, // its search is a worker from a blob, which the policy refuses
  document.querySelector("#redoc"),
);
