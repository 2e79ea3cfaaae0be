//! The house: who may import whom, how long a file may be, what may be named where.

use crate::world::workspace;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Module by module, what it may use of its own crate. `main` is the program; `tests` modules are free.
const PROTOCOL: &[(&str, &[&str])] = &[
    ("arguments", &[]),
    ("bintree", &[]),
    ("bitree", &["bintree"]),
    ("diamond", &["bintree"]),
    ("rans", &[]),
    ("points", &["bintree", "bitree", "diamond", "rans"]),
    ("tin", &["bintree", "bitree", "diamond", "rans"]),
    ("index", &["bintree", "diamond", "wire"]),
    ("projection", &["message"]),
    ("sight", &["bintree"]),
    ("texture", &[]),
    ("series", &[]),
    ("message", &["bintree", "diamond", "points", "series", "texture", "wire", "zone"]),
    ("zone", &["bintree", "diamond"]),
    ("wire", &[]),
];

/// Serving cannot reach building: `http` sees the store, and heights through it.
const SERVER: &[(&str, &[&str])] = &[
    ("projection", &[]),
    ("ingest", &["projection"]),
    ("canvas", &[]),
    ("chunks", &[]),
    ("measure", &[]),
    ("progress", &[]),
    ("tin", &[]),
    ("seldom", &[]),
    ("store", &["seldom"]),
    ("texture", &["ingest", "progress", "store"]),
    ("hierarchy", &["canvas", "chunks", "ingest", "measure", "progress", "store", "texture", "tin"]),
    ("inspect", &["chunks", "store"]),
    ("height", &["inspect", "projection", "store"]),
    ("stream", &["inspect", "store"]),
    ("curve", &["inspect", "store", "stream"]),
    ("size", &[]),
    ("http", &["height", "inspect", "seldom", "size", "store", "stream"]),
    ("settings", &["http", "size", "store"]),
    // What the program is told of layers, and what it prints.
    ("series_args", &[]),
    ("layer_args", &["series_args"]),
    ("arguments", &["layer_args"]),
    ("print", &["layer_args"]),
    ("sample", &[]),
    ("client_program", &[]),
    ("demo", &["client_program", "hierarchy", "http", "ingest", "progress", "sample"]),
    ("zone", &["height", "inspect", "progress", "projection", "store"]),
    (
        "experiment",
        &["canvas", "client_program", "hierarchy", "http", "ingest", "measure", "progress", "zone"],
    ),
];

/// `cut` is a pure function of what it is given; the GPU is `render`'s and the fronts'.
const CLIENT: &[(&str, &[&str])] = &[
    ("background", &[]),
    ("disk", &[]),
    ("camera", &[]),
    ("encoding", &[]),
    ("surface", &["encoding"]),
    ("picture", &[]),
    ("morph", &["surface"]),
    ("drawing", &["morph", "surface"]),
    ("cache", &["surface"]),
    ("fetch", &["background", "disk", "encoding"]),
    ("doctor", &["encoding", "fetch", "surface"]),
    ("load", &["cache", "camera", "cut", "encoding", "fetch", "headless", "overview", "sight", "surface"]),
    ("sight", &["camera"]),
    ("cut", &["camera", "drawing", "encoding", "morph", "sight", "surface"]),
    (
        "terrain",
        &[
            "background",
            "cache",
            "camera",
            "cut",
            "drawing",
            "encoding",
            "fetch",
            "mirror",
            "morph",
            "player",
            "sight",
            "surface",
            "texture",
        ],
    ),
    ("player", &[]),
    ("mirror", &["camera"]),
    ("texture", &["background", "camera"]),
    ("render", &["camera", "drawing", "mirror", "morph", "picture", "surface", "texture"]),
    ("controls", &["camera"]),
    ("pick", &["drawing", "surface"]),
    ("overview", &["camera"]),
    ("globe", &[]),
    // Over pictures with a window and without.
    ("annotate", &["camera", "drawing", "globe", "pick", "render"]),
    (
        "headless",
        &[
            "annotate", "camera", "drawing", "fetch", "globe", "overview", "pick", "picture", "player",
            "render", "surface", "terrain",
        ],
    ),
    (
        "viewer",
        &[
            "annotate", "camera", "controls", "drawing", "encoding", "globe", "headless", "overview", "pick",
            "picture", "player", "render", "surface", "terrain", "texture",
        ],
    ),
    ("web", &["encoding", "fetch", "render", "terrain", "texture", "viewer"]),
    // The command line.
    ("command", &[]),
    // The made scene of the crate's own tests.
    ("world", &["camera", "drawing", "encoding", "surface"]),
];

/// Lines that a file may have.
const LINES_MAX: usize = 1200;

/// Source files below a folder, with one of these endings.
fn sources(folder: &Path, endings: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            if path.is_dir() && !name.starts_with('.') && name != "target" {
                folders.push(path);
            } else if endings.iter().any(|ending| name.ends_with(ending)) {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap()
}

/// The text without comments and without what is in quotes, so that only code is judged.
fn code(text: &str) -> String {
    let mut out = String::new();
    for line in text.lines() {
        let mut quoted = false;
        let mut chars = line.chars().peekable();
        while let Some(c) = chars.next() {
            match c {
                '\\' if quoted => drop(chars.next()),
                '"' => quoted = !quoted,
                '/' if !quoted && chars.peek() == Some(&'/') => break,
                _ if quoted => {}
                c => out.push(c),
            }
        }
        out.push('\n');
    }
    out
}

/// The code without its `mod tests`: tests may use whatever shows the claim.
fn untested(text: &str) -> String {
    let code = code(text);
    code.split("#[cfg(test)]\nmod tests {")
        .next()
        .unwrap()
        .split("#[cfg(test)]\n#[allow(")
        .next()
        .unwrap()
        .to_owned()
}

/// What a text imports from its own crate: the first names behind `crate::`, in braces or not.
fn imports(code: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for (at, _) in code.match_indices("crate::") {
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_') {
            continue;
        }
        let rest = &code[at + "crate::".len()..];
        let name = |text: &str| -> String {
            text.trim_start().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
        };
        let Some(list) = rest.strip_prefix('{') else {
            found.insert(name(rest));
            continue;
        };
        // The first name of each item at the outermost depth of the braces.
        let (mut depth, mut start) = (0, true);
        for (i, c) in list.char_indices() {
            if start && depth == 0 && (c.is_alphanumeric() || c == '_') {
                found.insert(name(&list[i..]));
                start = false;
            }
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                ',' if depth == 0 => start = true,
                _ => {}
            }
        }
    }
    // Items of the crate's root, which are no modules.
    found.retain(|name| name.starts_with(|c: char| c.is_lowercase()));
    found
}

/// The top-level module that a file of `src` belongs to.
fn module(src: &Path, file: &Path) -> String {
    let inside = file.strip_prefix(src).unwrap();
    let first = inside.components().next().unwrap().as_os_str().to_string_lossy().into_owned();
    first.strip_suffix(".rs").unwrap_or(&first).to_owned()
}

#[test]
fn every_module_imports_only_what_the_table_allows() {
    let mut wrong = Vec::new();
    for (name, table) in [("protocol", PROTOCOL), ("server", SERVER), ("client", CLIENT)] {
        let table: BTreeMap<&str, &[&str]> = table.iter().copied().collect();
        let src = workspace().join(name).join("src");
        for file in sources(&src, &[".rs"]) {
            let here = module(&src, &file);
            let is_test = file.file_name().is_some_and(|n| n == "tests.rs")
                || file
                    .strip_prefix(&src)
                    .is_ok_and(|inside| inside.components().any(|c| c.as_os_str() == "tests"));
            if is_test || matches!(here.as_str(), "lib" | "main" | "bin") {
                continue;
            }
            let Some(allowed) = table.get(here.as_str()) else {
                wrong.push(format!(
                    "{}: module '{here}' is not in the table: say what it may use",
                    file.display()
                ));
                continue;
            };
            for import in imports(&untested(&read(&file))) {
                if import != here && !allowed.contains(&import.as_str()) {
                    wrong.push(format!("{}: '{here}' may not use '{import}'", file.display()));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn the_judge_sees_every_way_to_import() {
    let text = "use crate::a::B;\nuse crate::{c, d::{E, f}, G};\n// crate::h\nlet x = crate::i::j(\"crate::k\");\nuse mycrate::l;";
    assert_eq!(imports(&code(text)).into_iter().collect::<Vec<_>>(), ["a", "c", "d", "i"]);
}

#[test]
fn the_table_has_no_circles() {
    for table in [PROTOCOL, SERVER, CLIENT] {
        let mut done: BTreeSet<&str> = BTreeSet::new();
        while done.len() < table.len() {
            let next = table
                .iter()
                .find(|(name, uses)| !done.contains(name) && uses.iter().all(|u| done.contains(u)));
            assert!(next.is_some_and(|(name, _)| done.insert(name)), "a circle beyond {done:?}");
        }
    }
}

#[test]
fn server_and_client_meet_only_in_the_protocol() {
    for (name, stranger) in [("server", "diamantina_client"), ("client", "diamantina_server")] {
        for file in sources(&workspace().join(name), &[".rs", "Cargo.toml"]) {
            let text = code(&read(&file)).replace('-', "_");
            assert!(!text.contains(stranger), "{} names {stranger}", file.display());
        }
    }
    for file in sources(&workspace().join("protocol"), &[".rs", "Cargo.toml"]) {
        let text = code(&read(&file)).replace('-', "_");
        for stranger in
            ["diamantina_client", "diamantina_server", "tokio", "std::fs", "std::net", "std::thread"]
        {
            assert!(!text.contains(stranger), "{} names {stranger}", file.display());
        }
    }
}

#[test]
fn the_gpu_and_the_serialisation_are_each_named_in_one_place() {
    let judge = |name: &str, word: &str, homes: &[&str]| {
        let src = workspace().join(name).join("src");
        for file in sources(&src, &[".rs"]).iter().filter(|f| !homes.contains(&module(&src, f).as_str())) {
            let text = code(&read(file));
            assert!(!text.contains(word), "{} names {word}, which belongs in {homes:?}", file.display());
        }
    };
    judge("client", "wgpu::", &["render", "viewer", "headless", "web"]);
    judge("server", "wgpu", &[]);
    judge("protocol", "bincode", &["wire"]);
    judge("server", "bincode", &[]);
    judge("client", "bincode", &[]);
}

#[test]
fn files_are_short_and_finished() {
    let mut wrong = Vec::new();
    for file in sources(&workspace(), &[".rs", ".wgsl"]) {
        let text = read(&file);
        let lines = text.lines().count();
        if lines > LINES_MAX {
            wrong.push(format!("{}: {lines} lines, limit {LINES_MAX}: make a folder of it", file.display()));
        }
        for unfinished in
            [concat!("to", "do!"), concat!("unimple", "mented!"), concat!("db", "g!"), concat!("FIX", "ME")]
        {
            if text.contains(unfinished) {
                wrong.push(format!("{}: {unfinished}", file.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn every_shader_is_used() {
    let rust: String = sources(&workspace().join("client"), &[".rs"]).iter().map(|f| read(f)).collect();
    let shaders = sources(&workspace().join("shaders"), &[".wgsl"]);
    assert!(!shaders.is_empty());
    for shader in shaders {
        let name = shader.file_name().unwrap().to_string_lossy().into_owned();
        assert!(rust.contains(&format!("shaders/{name}\")")), "{name} is included nowhere");
    }
}

/// Without one of them cargo builds none.
#[test]
fn the_image_is_built_from_every_member_of_the_workspace() {
    let told = read(&workspace().join("Cargo.toml"));
    let members = told.split_once("members = [").and_then(|(_, rest)| rest.split_once(']')).unwrap().0;
    let members: Vec<&str> = members.split(',').map(|member| member.trim().trim_matches('"')).collect();
    assert!(members.contains(&"server"), "{members:?}");
    let ignored = read(&workspace().join(".dockerignore"));
    let copied: Vec<&str> = ignored.lines().filter_map(|line| line.strip_prefix('!')).collect();
    for needed in members.iter().chain(&["Cargo.toml", "Cargo.lock"]) {
        let within =
            |copied: &&str| needed.strip_prefix(copied).is_some_and(|r| r.is_empty() || r.starts_with('/'));
        assert!(copied.iter().any(within), ".dockerignore leaves out {needed}");
    }
}
