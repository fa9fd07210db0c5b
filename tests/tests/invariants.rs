//! The invariants of ARCHITECTURE.md that the dependency graph and the sources can show.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// Which of our crates each crate may use: the arrows of ARCHITECTURE.md and nothing else.
const ARROWS: &[(&str, &[&str])] = &[
    ("grnet-proto", &[]),
    ("grnet-frame", &[]),
    ("grnet-geometry", &[]),
    ("grnet-config", &["grnet-frame", "grnet-geometry"]),
    ("grnet-model", &[]),
    ("grnet-capture", &["grnet-frame", "grnet-geometry"]),
    ("grnet-pipeline", &["grnet-frame", "grnet-model", "grnet-geometry"]),
    ("grnet-client", &["grnet-proto", "grnet-geometry"]),
    (
        "grnetd",
        &[
            "grnet-pipeline",
            "grnet-capture",
            "grnet-proto",
            "grnet-config",
            "grnet-frame",
            "grnet-geometry",
            "grnet-model",
        ],
    ),
    ("grnet-train", &["grnet-pipeline", "grnet-model", "grnet-capture", "grnet-geometry", "grnet-frame"]),
    ("grnet-manual", &["grnetd", "grnet-client", "grnet-train", "grnet-config"]),
    ("grnet-tests", &[]),
];

fn workspace_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_path_buf()
}

fn metadata() -> Value {
    // Only this machine's packages are on disk; those of other platforms are nobody's dependency here.
    let rustc = Command::new("rustc").arg("-vV").output().expect("rustc runs");
    let about = String::from_utf8(rustc.stdout).unwrap();
    let host = about.lines().find_map(|line| line.strip_prefix("host: ")).expect("rustc names its host");
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--offline", "--filter-platform", host])
        .current_dir(workspace_root())
        .output()
        .expect("cargo runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("cargo metadata prints JSON")
}

/// Package id -> (name, normal dependencies' ids).
fn graph(metadata: &Value) -> BTreeMap<String, (String, Vec<String>)> {
    let names: BTreeMap<&str, &str> = metadata["packages"]
        .as_array()
        .unwrap()
        .iter()
        .map(|p| (p["id"].as_str().unwrap(), p["name"].as_str().unwrap()))
        .collect();
    let nodes = metadata["resolve"]["nodes"].as_array().unwrap().iter();
    nodes
        .map(|node| {
            let id = node["id"].as_str().unwrap();
            let normal = |d: &&Value| {
                d["dep_kinds"].as_array().unwrap().iter().any(|k| k["kind"].is_null() || k["kind"] == "build")
            };
            let deps = node["deps"].as_array().unwrap().iter().filter(normal);
            let deps = deps.map(|d| d["pkg"].as_str().unwrap().to_owned()).collect();
            (id.to_owned(), (names[id].to_owned(), deps))
        })
        .collect()
}

fn reachable(graph: &BTreeMap<String, (String, Vec<String>)>, from: &str) -> BTreeSet<String> {
    let start = graph.iter().find(|(_, (name, _))| name == from).expect("a workspace crate").0;
    let (mut seen, mut stack) = (BTreeSet::new(), vec![start.clone()]);
    while let Some(id) = stack.pop() {
        let (name, deps) = &graph[&id];
        if seen.insert(name.clone()) {
            stack.extend(deps.iter().cloned());
        }
    }
    seen
}

#[test]
fn crates_use_each_other_only_along_the_arrows() {
    let graph = graph(&metadata());
    let arrows: BTreeMap<_, _> = ARROWS.iter().copied().collect();
    let ours = |name: &str| name.starts_with("grnet");
    for (name, deps) in graph.values().filter(|(name, _)| ours(name)) {
        let allowed = arrows.get(name.as_str()).unwrap_or_else(|| panic!("{name} has no row in ARROWS"));
        for dep in deps.iter().map(|id| graph[id].0.as_str()).filter(|dep| ours(dep)) {
            assert!(allowed.contains(&dep), "{name} -> {dep} is not among the arrows of ARCHITECTURE.md");
        }
    }
    for name in arrows.keys() {
        assert!(graph.values().any(|(found, _)| found == name), "{name} is gone from the workspace");
    }
}

#[test]
fn the_client_never_links_the_network() {
    let graph = graph(&metadata());
    for name in ["grnet-client", "grnet-proto"] {
        let linked = reachable(&graph, name);
        let forbidden: Vec<_> =
            linked.iter().filter(|n| n.starts_with("candle") || *n == "grnet-model").collect();
        assert!(forbidden.is_empty(), "{name} links {forbidden:?}");
    }
}

#[test]
fn network_geometry_and_pipeline_know_no_wire_types() {
    let graph = graph(&metadata());
    for name in ["grnet-model", "grnet-geometry", "grnet-frame", "grnet-pipeline", "grnet-capture"] {
        let linked = reachable(&graph, name);
        let wire: Vec<_> =
            linked.iter().filter(|n| n.starts_with("iceoryx2") || *n == "grnet-proto").collect();
        assert!(wire.is_empty(), "{name} links {wire:?}");
    }
}

fn rust_sources(dir: &Path, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).unwrap().map(Result::unwrap) {
        let path = entry.path();
        let name = entry.file_name();
        if path.is_dir() {
            if name != "target" && !name.to_string_lossy().starts_with('.') {
                rust_sources(&path, into);
            }
        } else if path.extension().is_some_and(|e| e == "rs") {
            into.push(path);
        }
    }
}

/// Where handwritten `unsafe` may live. `grnet-proto`'s fence holds nothing but the `ZeroCopySend` promises.
const UNSAFE_FENCES: &[&str] =
    &["capture/src/v4l2/", "model/src/kernels/", "model/src/ops/gemm.rs", "model/src/device.rs", "client/c/"];

#[test]
fn unsafe_code_stays_behind_its_fences_and_says_why_it_is_sound() {
    let root = workspace_root();
    let mut files = Vec::new();
    rust_sources(&root, &mut files);
    assert!(files.len() > 40, "the walk over the sources found only {} files", files.len());
    // Assembled so that this file does not find itself.
    let (block, function, implementation) =
        (["unsafe", " {"].concat(), ["unsafe", " fn"].concat(), ["unsafe", " impl"].concat());
    for file in files {
        let text = std::fs::read_to_string(&file).unwrap();
        let relative = file.strip_prefix(&root).unwrap().to_string_lossy().replace('\\', "/");
        let lines: Vec<&str> = text.lines().collect();
        for (i, line) in lines.iter().enumerate() {
            let code = line.split("//").next().unwrap();
            if ![&block, &function, &implementation].iter().any(|marker| code.contains(marker.as_str())) {
                continue;
            }
            let fenced = UNSAFE_FENCES.iter().any(|fence| relative.starts_with(fence));
            assert!(fenced, "{relative}:{}: unsafe code outside {UNSAFE_FENCES:?}", i + 1);
            let noted = lines[i.saturating_sub(8)..=i]
                .iter()
                .any(|l| l.contains("SAFETY:") || l.contains("# Safety"));
            assert!(noted, "{relative}:{}: unsafe code without a SAFETY note", i + 1);
        }
    }
}

#[test]
fn source_files_keep_to_one_job() {
    let root = workspace_root();
    let mut files = Vec::new();
    rust_sources(&root, &mut files);
    for file in files {
        let count = std::fs::read_to_string(&file).unwrap().lines().count();
        let relative = file.strip_prefix(&root).unwrap().display();
        assert!(count <= 500, "{relative} has {count} lines: split it");
    }
}

/// Clocks are read where frames are made and where messages leave, never where poses are computed.
#[test]
fn the_step_reads_no_clock() {
    let root = workspace_root();
    for dir in ["pipeline/src", "model/src", "geometry/src", "frame/src"] {
        let mut files = Vec::new();
        rust_sources(&root.join(dir), &mut files);
        assert!(!files.is_empty(), "{dir} has no sources");
        for file in files {
            let text = std::fs::read_to_string(&file).unwrap();
            for clock in ["Instant::now", "SystemTime", "clock_gettime"] {
                assert!(!text.contains(clock), "{} reads a clock ({clock})", file.display());
            }
        }
    }
}
