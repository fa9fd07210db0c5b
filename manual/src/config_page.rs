//! `grnetd.toml(5)` from the commented example: its comments, its defaults, and what each key may be.

use grnet_config::{EXAMPLE, KEYS};
use roff::{Roff, bold, roman};

/// The page.
pub fn page() -> String {
    let mut roff = Roff::default();
    let version = concat!("grnet ", env!("CARGO_PKG_VERSION"));
    roff.control("TH", ["grnetd.toml", "5", "", version, "grnet"]);
    roff.control("SH", ["NAME"]).text([roman("grnetd.toml - configuration of grnetd")]);
    roff.control("SH", ["SYNOPSIS"]).text([roman("/etc/grnet/grnetd.toml")]);
    let mut example = EXAMPLE.split("\n\n").filter(|paragraph| !paragraph.trim().is_empty());
    let mut paragraphs = Vec::new();
    // What stands before the first section is about the whole file; its first line says what it is, as NAME does.
    let mut rest = Vec::new();
    for paragraph in example.by_ref() {
        if paragraph.lines().all(|line| line.starts_with('#')) {
            paragraphs.push(prose(paragraph.lines()));
        } else {
            rest.push(paragraph);
            break;
        }
    }
    rest.extend(example);
    roff.control("SH", ["DESCRIPTION"]);
    roff.text([roman(
        "The file is TOML. Every key is listed here with its default, or with an example where it has none.",
    )]);
    for paragraph in paragraphs.into_iter().skip(1) {
        roff.control("PP", []).text([roman(paragraph)]);
    }
    entries(&mut roff, &rest.join("\n\n"));
    roff.control("SH", ["SEE ALSO"]).text([roman("grnetd(8), grnet-client(1)")]);
    roff.render()
}

/// Sections and keys, each key with the comment above it and what it may be.
fn entries(roff: &mut Roff, text: &str) {
    let mut section = "";
    let mut comment: Vec<&str> = Vec::new();
    // Keys that stand under one comment, with their text.
    let mut keys: Vec<&str> = Vec::new();
    for line in text.lines().chain([""]) {
        let is_key = key_of(line).is_some();
        if !is_key && !keys.is_empty() {
            write_keys(roff, section, &keys, &prose(comment.drain(..)));
            keys.clear();
        }
        if let Some(name) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
            section = name;
            roff.control("SH", [format!("[{name}]").as_str()]);
            if !comment.is_empty() {
                roff.text([roman(prose(comment.drain(..)))]);
            }
        } else if is_key {
            keys.push(line);
        } else if line.starts_with('#') {
            comment.push(line);
        }
    }
}

fn write_keys(roff: &mut Roff, section: &str, lines: &[&str], comment: &str) {
    for (i, line) in lines.iter().enumerate() {
        let name = key_of(line).unwrap_or_default();
        let path = format!("{section}.{name}");
        let (value, allowed) = (line.split_once(" = ").map_or("", |(_, value)| value), allowed(&path));
        roff.control("TP", []);
        let remark = if line.starts_with('#') { " (an example; no default)" } else { "" };
        roff.text([bold(name), roman(format!(" = {value}{remark}"))]);
        if i == 0 && !comment.is_empty() {
            roff.text([roman(comment)]);
            roff.control("br", []);
        }
        roff.text([roman(format!("Allowed: {allowed}."))]);
    }
}

/// The key that a line sets, switched off or not.
fn key_of(line: &str) -> Option<&str> {
    let (name, _) = line.strip_prefix('#').unwrap_or(line).split_once(" = ")?;
    name.starts_with(|c: char| c.is_ascii_lowercase()).then_some(name).filter(|name| !name.contains(' '))
}

fn allowed(path: &str) -> &'static str {
    KEYS.iter().find(|key| key.path == path).map_or("", |key| key.allowed)
}

/// Comment lines as running text.
fn prose<'a>(lines: impl Iterator<Item = &'a str>) -> String {
    lines.map(|line| line.trim_start_matches('#').trim()).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_stands_in_the_page_with_what_it_may_be() {
        let page = page();
        let plain = page.replace("\\-", "-").replace("\\\\", "\\");
        for key in KEYS {
            let (section, name) = key.path.rsplit_once('.').unwrap();
            assert!(plain.contains(&format!("[{section}]")), "{section}");
            assert!(plain.contains(&format!("\\fB{name}\\fR = ")), "{name}");
        }
        assert_eq!(plain.matches("Allowed: ").count(), KEYS.len());
        assert!(!plain.contains("Allowed: ."), "a key of the example is not known");
    }

    #[test]
    fn comments_stand_by_their_keys() {
        let mut roff = Roff::default();
        entries(&mut roff, "# About.\n[log]\n# How\n# much.\nlevel = \"info\"\n#format = \"json\"\n");
        let text = roff.to_roff();
        let expected = ".SH [log]\nAbout.\n.TP\n\\fBlevel\\fR = \"info\"\nHow much.\n.br\n";
        assert!(text.starts_with(expected), "{text}");
        assert!(text.contains("\\fBformat\\fR = \"json\" (an example; no default)\n"), "{text}");
    }
}
