/** Requests to the server that the page came from. */

/** Why a request failed, in words for the user. */
export class RequestError extends Error {}

export class Api {
  /** @param {string} base Address of the page. @param {string} token Empty if the server asks for none. */
  constructor(base, token) {
    this.base = base;
    this.token = token;
  }

  /** @param {string} path */
  address(path) {
    return new URL(path, this.base);
  }

  /** Address of the WebSocket. */
  get track() {
    const address = this.address("v1/track");
    address.protocol = address.protocol.replace("http", "ws");
    return address.href;
  }

  /** @param {string} path @param {RequestInit} [options] @returns {Promise<Response>} */
  async get(path, options = {}) {
    const headers = this.token ? { Authorization: `Bearer ${this.token}` } : undefined;
    let response;
    try {
      response = await fetch(this.address(path), { ...options, headers, cache: "no-cache" });
    } catch {
      throw new RequestError("The server does not answer. Does it still run?");
    }
    if (response.ok) return response;
    const body = await response.json().catch(() => null);
    throw new RequestError(body?.error?.message ?? `The server answered ${response.status}.`);
  }

  /** @param {string} path @param {RequestInit} [options] @returns {Promise<any>} */
  async json(path, options) {
    return (await this.get(path, options)).json();
  }

  /** All maps, and whether there is a film to play instead of a camera. @returns {Promise<{maps: any[], film?: boolean}>} */
  maps() {
    return this.json("v1/maps");
  }

  /** The film. */
  async film() {
    return (await this.get("v1/film")).blob();
  }

  /** @param {string} id */
  points(id) {
    return this.json(`v1/maps/${encodeURIComponent(id)}/points`);
  }

  /** @param {string} id */
  model(id) {
    return this.json(`v1/maps/${encodeURIComponent(id)}/model`);
  }

  /** Localize one picture. @param {BufferSource} jpeg @param {string[]} maps @param {boolean} unknownFocal Whether to estimate the focal length from this picture alone. */
  localize(jpeg, maps, unknownFocal) {
    const query = new URLSearchParams(unknownFocal ? { focal: "unknown" } : {});
    if (maps.length) query.set("map", maps.join());
    return this.json(`v1/localize?${query}`, { method: "POST", body: new Blob([jpeg], { type: "image/jpeg" }) });
  }
}

/**
 * The token of the address's fragment, as the QR code has it; it is taken out of the address and kept for this tab.
 *
 * @param {Location} location @param {History} history @param {Storage} storage
 */
export function takeToken(location, history, storage) {
  const found = new URLSearchParams(location.hash.slice(1)).get("token");
  if (found) {
    storage.setItem("slimsfm.token", found);
    history.replaceState(null, "", location.pathname + location.search);
  }
  return found ?? storage.getItem("slimsfm.token") ?? "";
}
