//! What this server answers, as OpenAPI, made of the very table that the routes are made of.

use utoipa::openapi::path::{
    HttpMethod, Operation, OperationBuilder, Parameter, ParameterBuilder, ParameterIn,
};
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{
    Components, ContentBuilder, Info, ObjectBuilder, OpenApi, OpenApiBuilder, PathItem, Paths, Ref, RefOr,
    Required, Response, ResponseBuilder, Schema, Type,
};

/// What an answer holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Holds {
    Text,
    Html,
    Json,
    /// JSON that is made for each request, without a tag.
    Computed,
    Octets,
    /// A tile of a texture.
    Picture,
    Metrics,
    /// Scripts, styles, programs.
    Files,
}

/// What is told of a route.
#[derive(Debug, Clone, Copy)]
pub(super) struct About {
    pub(super) summary: &'static str,
    pub(super) holds: Holds,
    /// Names of parameters behind the question mark, whether each has to be there, and what it looks like.
    pub(super) query: &'static [(&'static str, bool, Form)],
    /// Statuses beside those that any request may get.
    pub(super) refusals: &'static [u16],
}

/// What a parameter looks like.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// A whole number from 0.
    Count,
    /// Bytes, from 1.
    Bytes,
    /// A number.
    Number,
    /// Letters, digits, '-', '_' and '.'.
    Name,
    /// x,y;x,y;... of centres of diamonds.
    Centres,
    /// Numbers with commas between.
    Numbers,
    /// Whatever the text of the summary says.
    Text,
}

/// The name of the scheme by which tokens come.
const TOKEN: &str = "token";

/// Statuses that any request may get.
const ALWAYS: [u16; 5] = [405, 413, 414, 429, 503];

impl Form {
    fn schema(self) -> Schema {
        let text = |pattern: Option<&str>| ObjectBuilder::new().schema_type(Type::String).pattern(pattern);
        match self {
            Self::Count => ObjectBuilder::new()
                .schema_type(Type::Integer)
                .minimum(Some(0))
                .maximum(Some(u32::MAX as usize)),
            Self::Bytes => ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(1)),
            Self::Number => ObjectBuilder::new().schema_type(Type::Number),
            Self::Name => text(Some("^[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}$")),
            Self::Centres => text(Some("^[0-9]{1,9},[0-9]{1,9}(;[0-9]{1,9},[0-9]{1,9}){0,100}$")),
            Self::Numbers => {
                text(Some("^-?[0-9]{1,9}(\\.[0-9]{1,6})?(,-?[0-9]{1,9}(\\.[0-9]{1,6})?){0,14}$"))
            }
            Self::Text => text(None),
        }
        .into()
    }
}

impl Holds {
    fn kind(self) -> &'static str {
        match self {
            Self::Text => "text/plain",
            Self::Html => "text/html",
            Self::Json | Self::Computed => "application/json",
            Self::Octets => "application/octet-stream",
            Self::Picture => "image/webp",
            Self::Metrics => "application/openmetrics-text",
            Self::Files => "*/*",
        }
    }
}

fn reason(status: u16) -> &'static str {
    axum::http::StatusCode::from_u16(status).ok().and_then(|s| s.canonical_reason()).unwrap_or("Refused")
}

fn response(status: u16, content: Option<(&str, RefOr<Schema>)>) -> Response {
    let response = ResponseBuilder::new().description(reason(status));
    match content {
        Some((kind, schema)) => response.content(kind, ContentBuilder::new().schema(Some(schema)).build()),
        None => response,
    }
    .build()
}

fn parameter(name: &str, place: ParameterIn, is_required: bool, form: Form) -> Parameter {
    let required = if is_required { Required::True } else { Required::False };
    ParameterBuilder::new()
        .name(name)
        .parameter_in(place)
        .required(required)
        .schema(Some(form.schema()))
        .build()
}

fn operation(template: &str, about: &About) -> Operation {
    let mut operation = OperationBuilder::new().summary(Some(about.summary));
    for name in template.split('/').filter_map(|part| part.strip_prefix('{')?.strip_suffix('}')) {
        let form = if matches!(name, "x" | "y" | "page" | "level") { Form::Count } else { Form::Name };
        operation = operation.parameter(parameter(name, ParameterIn::Path, true, form));
    }
    for (name, is_required, form) in about.query {
        operation = operation.parameter(parameter(name, ParameterIn::Query, *is_required, *form));
    }
    if template.starts_with("/scenes") {
        // Scenes that are not private need none.
        let token = SecurityRequirement::new(TOKEN, [""; 0]);
        operation = operation.security(SecurityRequirement::default()).security(token);
    }
    let schema = match about.holds {
        Holds::Json | Holds::Computed => ObjectBuilder::new().schema_type(Type::Object),
        _ => ObjectBuilder::new().schema_type(Type::String),
    };
    let held = response(200, Some((about.holds.kind(), RefOr::T(schema.into()))));
    operation = operation.response("200", held);
    if matches!(about.holds, Holds::Json | Holds::Octets | Holds::Picture | Holds::Html | Holds::Files) {
        operation = operation.response("304", response(304, None));
        operation = operation.response("412", response(412, Some(problem())));
    }
    for status in about.refusals.iter().chain(&ALWAYS) {
        operation = operation.response(status.to_string(), response(*status, Some(problem())));
    }
    operation.build()
}

/// What refusals hold.
fn problem() -> (&'static str, RefOr<Schema>) {
    ("application/problem+json", RefOr::Ref(Ref::from_schema_name("Problem")))
}

/// The document of all routes.
pub(super) fn document<'a>(routes: impl Iterator<Item = (&'a str, &'a About)>) -> OpenApi {
    let mut paths = Paths::new();
    for (template, about) in routes {
        let item = PathItem::new(HttpMethod::Get, operation(template, about));
        paths.paths.insert(template.to_owned(), item);
    }
    let field = |kind| ObjectBuilder::new().schema_type(kind).build();
    let problem = ObjectBuilder::new()
        .schema_type(Type::Object)
        .property("title", field(Type::String))
        .property("status", field(Type::Integer))
        .property("detail", field(Type::String));
    let problem = ["title", "status", "detail"].into_iter().fold(problem, |p, name| p.required(name));
    let mut components = Components::new();
    components.schemas.insert("Problem".to_owned(), RefOr::T(problem.build().into()));
    let bearer = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .description(Some("Of a private scene. Without it such a scene is not there: 404, and in no list."))
        .build();
    components.security_schemes.insert(TOKEN.to_owned(), SecurityScheme::Http(bearer).into());
    let mut info = Info::new("Diamantina", env!("CARGO_PKG_VERSION"));
    info.description = Some(
        "Streams terrain. HEAD is answered wherever GET is. Refusals are problem+json (RFC 9457). What is below a \
         version never changes; a version that another took the place of is refused with 410, which names it. What is no \
         HTTP is refused with 400, and a head above 32 KiB or with more than 100 fields with 431, before it is known what \
         is asked for, and without a body."
            .to_owned(),
    );
    OpenApiBuilder::new().info(info).paths(paths).components(Some(components)).build()
}
