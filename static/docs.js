// The API's documentation, drawn by Swagger UI from this server's OpenAPI document.
SwaggerUIBundle({
  url: "/openapi.json",
  dom_id: "#docs",
  deepLinking: true,
  validatorUrl: null, // nothing is sent to another host
  syntaxHighlight: false, // its themes are inline styles, which the content security policy refuses
});
