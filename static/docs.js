// The API's documentation, drawn by Swagger UI from this server's OpenAPI document.
SwaggerUIBundle({
  url: "/openapi.json",
  dom_id: "#docs",
  deepLinking: true,
  validatorUrl: null, // nothing is sent to another host
  requestInterceptor: (request) => Object.assign(request, { credentials: "omit" }), // no password dialogue of the browser
  syntaxHighlight: false, // its themes are inline styles, which the content security policy refuses
});
