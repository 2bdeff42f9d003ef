"""A page in Chromium that asks for nothing and complains of nothing."""

from contextlib import contextmanager


@contextmanager
def quiet_page(chromium, path, look):
    """A page, drawn; at the end it must have asked for nothing and complained of nothing."""
    width, scheme = look
    context = chromium.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    context.set_default_timeout(120_000)  # a busy machine is no fault of a page
    tab, complaints, asked = context.new_page(), [], []
    tab.on("console", lambda said: complaints.append(said.text) if said.type in {"error", "warning"} else None)
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.on("request", lambda sent: asked.append(sent.url) if not sent.url.startswith(("data:", "blob:")) else None)
    url = path.as_uri()
    tab.goto(url)
    tab.wait_for_selector("html[data-ready]")
    yield tab
    assert complaints == []
    assert asked == [url]
    context.close()
