"""Says where the page is."""

from __future__ import annotations

from fetch_hand_sim.view.web import Address, has_display, open_browser


def announce(address: Address, wants_browser: bool) -> None:
    """Prints the address and opens it where a browser could show itself."""
    if address.warning:
        print(f'Warning: {address.warning}', flush=True)
    print(f'The page is at {address.url} (Ctrl-C ends)', flush=True)
    if wants_browser and has_display():
        open_browser(address.url)
