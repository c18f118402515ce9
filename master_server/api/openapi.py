# SPDX-License-Identifier: Apache-2.0
"""The OpenAPI description: the answers and refusals of each route, and examples for the watched cell.

FastAPI knows the models. This module adds the rest: the one shape of all refusals, `POST /update`, which bypasses
FastAPI, and examples that work as they are.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fastapi_offline
import numpy as np
from fastapi import FastAPI
from fastapi.openapi.docs import get_redoc_html, get_swagger_ui_html
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, Field
from starlette.responses import FileResponse, HTMLResponse, Response

from master_server.core import Readable
from shared.camera import Intrinsics
from shared.clock import monotonic_ns
from shared.errors import Refusal
from shared.messages import (
    CONTRACT_MINOR,
    CONTRACT_VERSION,
    Health,
    InitializeRequest,
    PoseRequest,
    UpdateAnswer,
    UpdateRequest,
)
from shared.transforms import look_at
from shared.wire import MEDIA_TYPE, ROWS

ASSETS = Path(fastapi_offline.__file__).parent / "static"

ASSETS_PATH = "/docs/assets"

ASSET_TYPES = {
    "swagger-ui-bundle.js": "text/javascript",
    "swagger-ui.css": "text/css",
    "redoc.standalone.js": "text/javascript",
    "favicon.png": "image/png",
}

TEXT = """JSON by default; msgpack where `Accept` or `Content-Type` is `application/msgpack`. Times are nanoseconds,
lengths metres, angles radians; `T_a_b` maps points of frame b into frame a. A refusal is always
`{"detail": "one sentence"}` in JSON.

`WS /stream` sends the merged map as it changes (`form`, `encoding` and `unseen` as in its query); its token comes in
the header `Authorization`, or as the subprotocol `bearer.<token>` beside `cellwatch`."""

REASONS = {
    400: "The request contradicts itself, or the unit speaks another contract.",
    401: "No valid token.",
    403: "The token belongs to another role, or the unit to another address.",
    404: "The named thing does not exist here.",
    408: "The body came too slowly.",
    409: "Not now: something else is in progress, or the data is older than the known data.",
    413: "The body is too large.",
    415: "The body is of another type.",
    422: "A field is missing, unknown, of another type or out of range; it is named.",
    429: "Too many requests, or too many wrong tokens, from this address; `Retry-After` gives the time to wait.",
    503: "The master has reached a bound, such as its number of units.",
    504: "The unit did not answer in time.",
    507: "The disk is full.",
}

SPECIFIC: dict[tuple[str, str], frozenset[int]] = {
    ("post", "/initialize"): frozenset({400, 409, 503}),
    ("post", "/update"): frozenset({404, 409}),
    ("put", "/cell"): frozenset({409, 415, 507}),
    ("put", "/cell/objects/{name}/pose"): frozenset({404}),
    ("get", "/cell/meshes/{sha256}"): frozenset({404}),
    ("put", "/robot/joints"): frozenset({404, 409}),
    ("get", "/recording"): frozenset({409}),
    ("post", "/recording"): frozenset({409, 507}),
    ("delete", "/recording"): frozenset({409, 507}),
    ("get", "/units/{unit_id}/images/{kind}"): frozenset({409, 504}),
    ("put", "/units/{unit_id}/images/{kind}"): frozenset({409}),
}
"""Refusals in addition to those that follow from a route's token, parameters and body."""

COMMANDS = ("background", "calibrate", "refine")
"""Commands to a unit: refused if too many wait for it."""

BEARER: list[dict[str, list[str]]] = [{"HTTPBearer": []}]


class ErrorAnswer(BaseModel):
    """Every refusal."""

    detail: str = Field(description="One sentence that names the field, what was expected and what came.")


def describe(app: FastAPI, replay: bool) -> dict[str, Any]:
    """Return the OpenAPI document of the application, without examples; this takes 0.1 s.

    A replay refuses every change.
    """
    document = get_openapi(title=app.title, version=app.version, description=TEXT, routes=app.routes)
    document["paths"]["/update"] = {"post": _update()}
    schemas = document["components"]["schemas"]
    for gone in ("HTTPValidationError", "ValidationError"):
        schemas.pop(gone, None)
    for model in (ErrorAnswer, UpdateAnswer, UpdateRequest):
        schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
        for name, part in schema.pop("$defs", {}).items():
            schemas.setdefault(name, part)
        schemas[model.__name__] = schema
    _as_on_the_wire(schemas)
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            operation["summary"] = operation.get("description", operation["summary"]).split("\n")[0].rstrip(".")
            refusals = _refusals(method, path, operation)
            if replay and method != "get":
                refusals |= {409}
            for status in sorted(refusals):
                operation["responses"][str(status)] = _refusal(status)
    return document


def illustrate(document: dict[str, Any], master: Readable) -> None:
    """Put examples for the currently watched cell into `document`, replacing those of another cell."""
    examples = Examples(master)
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            for parameter in operation.get("parameters", ()):
                if (found := examples.of_parameter(parameter["name"])) is not None:
                    parameter["example"] = found
            for media_type, content in operation.get("requestBody", {}).get("content", {}).items():
                content["schema"].pop("examples", None)
                found = examples.of_body(method, path, media_type)
                if found is not None:
                    content["examples"] = {name: {"value": value} for name, value in found.items()}


class Examples:
    """Bodies and parameters that this master accepts, once its first unit has registered."""

    def __init__(self, master: Readable) -> None:
        self._master = master

    def of_parameter(self, name: str) -> Any:
        """Return an example value; None if there is none."""
        document = self._master.published.document
        known: dict[str, Callable[[], Any]] = {
            "unit_id": lambda: 1,
            "sha256": lambda: next(iter(self._master.published.meshes), "0" * 64),
            "name": lambda: next(_names(document.get("objects")), "pallet"),
            "kind": lambda: "depth",
            "form": lambda: "centres",
            "unseen": lambda: True,
            "blocks": lambda: True,
            "since_ns": lambda: 0,
            "raw": lambda: True,
            "command": lambda: 1,
        }
        return known[name]() if name in known else None

    def of_body(self, method: str, path: str, media_type: str) -> dict[str, Any] | None:
        """Return named bodies; None without an example, as for a zip."""
        if media_type == MEDIA_TYPE and path == "/update":
            return {"one voxel": self._update()}
        if media_type != "application/json":
            return None
        known: dict[tuple[str, str], Callable[[], dict[str, Any]]] = {
            ("post", "/initialize"): lambda: {"a camera": self._initialize()},
            ("put", "/settings"): lambda: {
                "smaller voxels": {"voxel_size_m": 0.04},
                "impatient": {"stale_after_s": 0.4},
            },
            ("put", "/robot/joints"): self._joints,
            ("put", "/units/{unit_id}/pose"): lambda: {"in a corner": self._pose()},
            ("put", "/replay"): lambda: {"back to its beginning": {"position_s": 0.0, "playing": False}},
            ("put", "/cell"): lambda: {"as it is": self._master.published.document},
            ("put", "/cell/objects/{name}/pose"): lambda: {
                "moved": {"T_world_object": [[1, 0, 0, 0.5], [0, 1, 0, 0.5], [0, 0, 1, 0], [0, 0, 0, 1]]}
            },
        }
        return known[method, path]() if (method, path) in known else None

    def _initialize(self) -> dict[str, Any]:
        request = InitializeRequest(
            contract=CONTRACT_VERSION,
            contract_minor=CONTRACT_MINOR,
            serial="233522071234",
            model="Intel RealSense D435",
            intrinsics=Intrinsics(848, 480, 425.0, 425.0, 423.5, 239.5),
            software="0.1.0",
            boot_id="b2f1",
            sent_at_ns=monotonic_ns(),
        )
        return request.model_dump(mode="json", exclude_none=True)

    def _joints(self) -> dict[str, Any]:
        count = len(self._master.robot_answer(None, monotonic_ns()).joint_names)
        return {
            "standing": {"positions": [0.1] * count},
            "moving": {"positions": [0.1] * count, "velocities": [0.0] * count},
        }

    def _pose(self) -> dict[str, Any]:
        document = self._master.published.document
        low, high = np.asarray(document["box_min_m"]), np.asarray(document["box_max_m"])
        pose = look_at(high, (low + high) / 2.0)
        return PoseRequest.model_validate({"T_world_camera": pose.tolist()}).model_dump(mode="json")

    def _update(self) -> dict[str, Any]:
        now_ns = monotonic_ns()
        return {
            "id": self.of_parameter("unit_id"),
            "session": 0,
            "sequence": 1,
            "captured_at_ns": now_ns,
            "sent_at_ns": now_ns,
            "versions": [1, 1, 1, 0],
            "keys": b64encode((0).to_bytes(4, "little")).decode(),
            "health": list(Health(valid_share=0.9, agreeing_share=0.95, static_share=0.6).model_dump().values()),
        }


def serve_documentation(app: FastAPI) -> None:
    """Serve `/docs` and `/redoc` from our own files: a cell has no internet, so no page may load anything from it."""

    @app.get(f"{ASSETS_PATH}/{{name}}", include_in_schema=False)
    async def asset(name: str) -> Response:
        if name not in ASSET_TYPES:
            raise Refusal(404, f"{name}: no page of the documentation uses such a file")
        return FileResponse(ASSETS / name, media_type=ASSET_TYPES[name])

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return get_swagger_ui_html(
            openapi_url="/openapi.json",
            title=app.title,
            swagger_js_url=f"{ASSETS_PATH}/swagger-ui-bundle.js",
            swagger_css_url=f"{ASSETS_PATH}/swagger-ui.css",
            swagger_favicon_url=f"{ASSETS_PATH}/favicon.png",
            # Otherwise the page sends the document to a validator on the internet.
            swagger_ui_parameters={"validatorUrl": None},
        )

    @app.get("/redoc", include_in_schema=False)
    async def redoc() -> HTMLResponse:
        return get_redoc_html(
            openapi_url="/openapi.json",
            title=app.title,
            redoc_js_url=f"{ASSETS_PATH}/redoc.standalone.js",
            redoc_favicon_url=f"{ASSETS_PATH}/favicon.png",
            with_google_fonts=False,
        )


def _names(objects: Any) -> Iterator[str]:
    for one in objects or ():
        yield one["name"] if isinstance(one, dict) else one


def _refusals(method: str, path: str, operation: dict[str, Any]) -> frozenset[int]:
    found = {429}
    if "security" in operation:
        found.add(401)
        if method != "get":
            found.add(403)
    if operation.get("parameters"):
        found.add(422)
    if method in ("post", "put"):
        # Also for routes without a body: a body that comes is read, and must match its Content-Type.
        found |= {400, 408, 413, 422}
    if path.startswith("/units/{unit_id}"):
        found.add(404)
    if path.endswith(COMMANDS):
        found.add(409)
    return SPECIFIC.get((method, path), frozenset()) | found


def _refusal(status: int) -> dict[str, Any]:
    answer: dict[str, Any] = {
        "description": REASONS[status],
        "content": {"application/json": {"schema": {"$ref": "#/components/schemas/ErrorAnswer"}}},
    }
    if status == 429:
        answer["headers"] = {"Retry-After": {"schema": {"type": "integer"}, "description": "Seconds."}}
    return answer


def _update() -> dict[str, Any]:
    return {
        "tags": ["units"],
        "summary": "A unit reports its newest frame.",
        "description": "A unit reports its newest frame; its earlier report is replaced.\n\n"
        "msgpack both ways. The examples show the decoded map, with binary fields in base64.",
        "operationId": "update_update_post",
        "security": BEARER,
        "requestBody": {
            "required": True,
            "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/UpdateRequest"}}},
        },
        "responses": {
            "200": {
                "description": "State that the unit needs next. Fields at their default are left out.",
                "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/UpdateAnswer"}}},
            }
        },
    }


def _as_on_the_wire(schemas: dict[str, Any]) -> None:
    """Adapt the schemas to the wire: in an update and its answer, rows have no names and bytes are bytes."""
    for name in ("UpdateRequest", "UpdateAnswer"):
        properties = schemas[name]["properties"]
        for field, model in ROWS.items():
            if field in properties:
                of = ", ".join(model.model_fields)
                count = len(model.model_fields)
                properties[field] = {
                    "type": "array",
                    "minItems": count,
                    "maxItems": count,
                    "description": f"The values of {of}.",
                    "prefixItems": list(schemas[model.__name__]["properties"].values()),
                }
    for name, field in (("UpdateRequest", "keys"), ("SeenReport", "bits")):
        found = schemas[name]["properties"][field]
        found.pop("format", None)
        found.pop("default", None)
        found["contentEncoding"] = "base64"
    schemas["UpdateAnswer"]["properties"]["joints"] = {
        "type": "array",
        "description": "Rows of time, positions and velocities, the last two as little-endian float32.",
        "items": {"type": "array", "minItems": 3, "maxItems": 3, "items": {}},
    }
