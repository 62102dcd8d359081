"""The OpenAPI document: every body is a named model whose members are all stated."""

import copy

import pytest

from optodrive.daemon.api.route_table import RouteTable
from optodrive.daemon.responses.telemetry import EVENTS


@pytest.fixture(scope="module")
def document(app):
    return app.openapi()


def list_schemas(node):
    """Every schema within a node of the document."""
    if isinstance(node, dict):
        yield node
        for item in node.values():
            yield from list_schemas(item)
    elif isinstance(node, list):
        for item in node:
            yield from list_schemas(item)


def list_responses(document):
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            for status, response in operation["responses"].items():
                for media_type, content in response.get("content", {}).items():
                    yield f"{method} {path} {status}", media_type, content["schema"]


def test_every_json_response_is_a_named_model(document):
    schemas = document["components"]["schemas"]
    named = set()
    for place, media_type, schema in list_responses(document):
        if "json" in media_type:
            assert list(schema) == ["$ref"], place
            named.add(schema["$ref"].rpartition("/")[2])
    assert {"StateReport", "PlanReport", "HealthReport", "PatternList", "EffectiveConfig", "Problem"} <= named
    assert named < set(schemas)


def test_every_reference_leads_to_a_component(document):
    schemas = document["components"]["schemas"]
    for node in list_schemas(document):
        if isinstance(node.get("$ref"), str):
            assert node["$ref"].removeprefix("#/components/schemas/") in schemas


def test_no_model_allows_members_that_it_does_not_state(document):
    for name, schema in document["components"]["schemas"].items():
        for node in list_schemas(schema):
            assert node.get("additionalProperties") is not True, name
            if node.get("type") == "object":
                assert "additionalProperties" in node, name
    assert '"additionalProperties": True' not in repr(document)


def list_undescribed(name, schema):
    """Yield the members without a description, except those that only narrow what is described beside them."""
    for node in list_schemas(schema):
        members = node.get("properties", {})
        if all(isinstance(content, dict) for content in members.values()):
            for member, content in members.items():
                states = set(content) & {"type", "$ref", "anyOf", "oneOf", "enum"}
                if states and not str(content.get("description", "")).strip():
                    yield f"{name}.{member}"


def test_every_member_is_described(document):
    undescribed = list(list_undescribed("document", document))
    assert undescribed == []


def test_an_undescribed_member_is_found(document):
    schema = document["components"]["schemas"]["BoardReport"]
    bare = {**schema["properties"]["uid"]}
    assert bare.pop("description")
    broken = {**schema, "properties": {**schema["properties"], "uid": bare}}
    assert list(list_undescribed("BoardReport", broken)) == ["BoardReport.uid"]


def test_every_event_has_its_model(document):
    schema = document["paths"]["/v1/telemetry"]["get"]["responses"]["200"]["content"]["text/event-stream"]["schema"]
    stated = {
        item["properties"]["event"]["const"]: item["properties"]["data"]["contentSchema"]["$ref"].rpartition("/")[2]
        for item in schema["oneOf"]
    }
    assert stated == {event: model.__name__ for event, model in EVENTS.items()}


def test_responses_require_every_member_problems_only_the_common_ones(document):
    schemas = document["components"]["schemas"]
    assert set(schemas["Problem"]["required"]) == {"type", "title", "status", "detail", "code"}
    for name in ("StateReport", "BoardReport", "PlanReport", "PlanSummary", "FeasibilityReport", "DisplayEvent"):
        assert set(schemas[name]["required"]) == set(schemas[name]["properties"]), name


def test_the_links_from_a_new_plan_lead_to_operations(document):
    operations = {operation["operationId"] for methods in document["paths"].values() for operation in methods.values()}
    links = document["paths"]["/v1/plans"]["post"]["responses"]["201"]["links"]
    assert {link["operationId"] for link in links.values()} < operations


def test_every_operation_names_its_role_and_the_document_is_served(app, document, send):
    roles = RouteTable(app.routes).roles
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            assert operation["x-min-role"] == roles[f"{method.upper()} {path}"]
    assert send("GET", "/openapi.json", "viewer").json() == document
    assert send("GET", "/openapi.json", None).status_code == 401


def list_nameless(document):
    """List what makes a generated client worse: nameless models, and what says nothing about itself."""
    schemas, found = document["components"]["schemas"], []
    for name, schema in schemas.items():
        parts = [*schema.get("anyOf", ()), *schema.get("oneOf", ())]
        members = schema.get("properties", {})
        for member in members.values():
            items = member.get("items", {})
            choices = [*member.get("oneOf", ()), *member.get("anyOf", ()), *items.get("oneOf", ())]
            parts += [member, items, *choices]
        found += [name for part in parts if "properties" in part]
        found += [name] * ("description" not in schema)
        found += [f"{name}.{key}" for key, member in members.items() if "description" not in member]
    tags = {tag["name"]: tag["description"] for tag in document.get("tags", ())}
    for path, methods in document["paths"].items():
        for operation in methods.values():
            (tag,) = operation["tags"]
            body = operation.get("requestBody", {"description": "none"})
            said = [tags.get(tag), operation.get("description"), body.get("description")]
            said += [item.get("description") for item in operation.get("parameters", ())]
            found += [path] * (not all(said))
            found += [path for item in body.get("content", {}).values() if "$ref" not in item["schema"]]
    return found


def test_bodies_and_their_parts_are_named_and_everything_is_described(document):
    assert list_nameless(document) == []
    document = copy.deepcopy(document)
    schemas = document["components"]["schemas"]
    del document["tags"][-1], schemas["HeightFrame"]["properties"]["id"]["description"]
    schemas["FrameSequence"]["anyOf"] = [{"properties": {"frames": {"minItems": 1}}}]
    assert list_nameless(document) == ["FrameSequence", "HeightFrame.id", "/v1/patterns", "/v1/patterns/{name}"]


def test_members_have_the_descriptions_of_their_docstring(document):
    members = document["components"]["schemas"]["FrameResult"]["properties"]
    described = [name for name, schema in members.items() if "description" in schema]
    assert len(described) > 10
    fingers = document["components"]["schemas"]["FingerMessage"]["properties"]
    assert fingers["radius_m"]["description"] == "of the contact"
    assert fingers["x_m"]["description"] == fingers["y_m"]["description"]
    assert fingers["x_m"]["description"].endswith("the display's pixels")
