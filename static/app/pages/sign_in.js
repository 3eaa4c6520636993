// The address to which an identity provider sends the browser back, with a code that becomes a token.

import { html } from "htm/preact";
import { useEffect, useState } from "preact/hooks";

import { Problem } from "../api/client.js";
import { ProblemBox } from "../components/problem.js";
import { SignIn } from "../components/sign_in.js";
import { navigate } from "../router.js";
import { finishSignIn, key, pageSettings } from "../session.js";
import { t } from "../texts/index.js";

/** @param {{ query: URLSearchParams }} props */
export default function SignInPage({ query }) {
  const [error, setError] = useState(/** @type {unknown} */ (null));
  const options = pageSettings.value?.sign_in;
  const answered = query.has("code") || query.has("error");
  useEffect(() => {
    if (!options || !answered) return;
    finishSignIn(options, query).then(
      (back) => navigate(back, { replace: true }),
      (problem) => setError(new Problem({ title: t("signin.failed"), detail: problem.message === "state" ? t("signin.failed_state") : String(problem.message), cure: t("signin.again") })),
    );
  }, [options, answered]);
  useEffect(() => {
    if (key.value && !answered) navigate("/", { replace: true });
  }, [key.value, answered]);
  if (answered && !error) return html`<h1>${t("signin.title")}</h1><p class="loading" role="status">${t("load.loading")}</p>`;
  return html`<${ProblemBox} error=${error} /><${SignIn} />`;
}
