"""The documentation site: it builds without a warning, loads nothing from another host, and is
searched and fits a phone when it is opened as files.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from browser import browser, lack

ROOT = Path(__file__).parents[2]
FAULTS = """
    const missing = [...document.images].filter(i => i.complete && !i.naturalWidth);
    const wide = document.documentElement.scrollWidth > innerWidth;
    return missing.map(i => i.src).concat(wide ? ["wider than the window"] : []);
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", folder],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_the_site_needs_no_other_host_and_has_no_formula_as_text(site):
    pages = list(site.rglob("*.html"))
    assert {"index.html", "paper.html", "api.html", "contributing.html"} <= {p.name for p in pages}
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|img|link|iframe)[^>]*?(?:src|href)=\"?([^\s\">]+)", text)
        assert not [url for url in loaded if re.match(r"(https?:)?//", url)], page.name
        if page.parent.name == "explanation":
            text = re.sub(r"<(pre|code|script|style).*?</\1>", "", text, flags=re.S)
            assert "$" not in text, page.name
    assert "<math" in (site / "explanation" / "paper.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.skipif(bool(lack()), reason=lack())
def test_pages_opened_as_files_fit_a_phone_and_are_searched(site, tmp_path):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.wait import WebDriverWait

    with browser(tmp_path, 390, 844) as driver:
        for page in sorted(site.glob("*/*.html")):
            driver.get(page.as_uri())
            assert driver.execute_script(FAULTS) == [], page.name
    with browser(tmp_path / "wide", 1440, 900) as driver:
        driver.get((site / "howto" / "boards.html").as_uri())
        driver.find_element(By.NAME, "query").send_keys("quantiser")
        found = WebDriverWait(driver, 60).until(
            lambda d: d.find_elements(By.CLASS_NAME, "md-search-result__link")
        )
        assert "explanation/paper.html" in found[0].get_attribute("href")
