//! YAML files of cameras: bounded before they are parsed, with errors that name the line.

use std::borrow::Cow;

use saphyr::{LoadableYamlNode, MarkedYaml, YamlData};

use super::DatasetError;
use super::text::{Line, TextFile};

/// Longest file that is read: the real ones have one or two kilobytes, and nesting costs stack.
const MAX_BYTES: usize = 64 * 1024;

/// Lists and tables that may be opened, and so the deepest nesting; a chain of eight cameras has fewer than a hundred.
const MAX_BRACKETS: usize = 200;

/// Deepest indentation that is read; the real files have three levels.
const MAX_INDENT: usize = 64;

/// Most references to other parts of the file; each multiplies what is kept of it.
const MAX_ALIASES: usize = 8;

/// A file that is being read.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reader<'a> {
    pub file: &'a TextFile,
    /// What it should be: `a camera's sensor.yaml`.
    pub what: &'static str,
}

impl<'a> Reader<'a> {
    /// The text as YAML: OpenCV's `%YAML:1.0` is no YAML directive; commenting it out keeps the line numbers.
    pub fn text(&self) -> Cow<'a, str> {
        let text = self.file.text();
        if text.starts_with("%YAML:") { format!("#{text}").into() } else { text.into() }
    }

    /// Parses `text` (of [`Reader::text`]); the root of its first document, a mapping.
    pub fn root<'t>(&self, text: &'t str) -> Result<MarkedYaml<'t>, DatasetError> {
        let count = |wanted: &[u8]| text.bytes().filter(|byte| wanted.contains(byte)).count();
        let indent = text.lines().map(|line| line.len() - line.trim_start_matches([' ', '-']).len()).max();
        let too_much = text.len() > MAX_BYTES
            || count(b"[{") > MAX_BRACKETS
            || count(b"*") > MAX_ALIASES
            || indent > Some(MAX_INDENT);
        if too_much {
            return Err(self
                .line(1)
                .error("a file too long or too deep", format!("{} of about one kilobyte", self.what)));
        }
        let documents = MarkedYaml::load_from_str(text).map_err(|error| {
            self.line(error.marker().line().max(1)).error(format!("bad YAML ({})", error.info()), self.what)
        })?;
        documents
            .into_iter()
            .next()
            .filter(|root| root.data.is_mapping())
            .ok_or_else(|| self.line(1).error("no keys", self.what))
    }

    /// `N` finite numbers in a list.
    pub fn numbers<const N: usize>(
        &self,
        node: &MarkedYaml<'_>,
        expected: &str,
    ) -> Result<[f64; N], DatasetError> {
        let all = self.list(node, expected)?;
        all.as_slice().try_into().map_err(|_| self.at(node).error(format!("{} entries", all.len()), expected))
    }

    /// Finite numbers in a list.
    pub fn list(&self, node: &MarkedYaml<'_>, expected: &str) -> Result<Vec<f64>, DatasetError> {
        let Some(all) = untagged(node).as_sequence() else {
            return Err(self.at(node).error("no list", expected));
        };
        all.iter()
            .map(|entry| {
                number(entry)
                    .ok_or_else(|| self.at(entry).error("an entry that is no finite number", expected))
            })
            .collect()
    }

    /// A number, or a switch.
    pub fn number_or_switch(&self, node: &MarkedYaml<'_>, expected: &str) -> Result<f64, DatasetError> {
        let switch = untagged(node).as_bool().map(|is_on| if is_on { 1.0 } else { 0.0 });
        number(node).or(switch).ok_or_else(|| self.at(node).error("no number", expected))
    }

    /// A whole number of pixels.
    pub fn pixels(&self, node: &MarkedYaml<'_>, expected: &str) -> Result<u32, DatasetError> {
        let value = number(node).ok_or_else(|| self.at(node).error("no number", expected))?;
        self.whole_pixels(node, value, expected)
    }

    /// A value of `node` as a whole number of pixels.
    pub fn whole_pixels(
        &self,
        node: &MarkedYaml<'_>,
        value: f64,
        expected: &str,
    ) -> Result<u32, DatasetError> {
        let whole = value.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&value);
        if whole { Ok(value as u32) } else { Err(self.at(node).error(value, expected)) }
    }

    /// The line at which a node begins.
    pub fn at(&self, node: &MarkedYaml<'_>) -> Line<'a> {
        self.line(node.span.start.line().max(1))
    }

    /// A line by its number.
    pub fn line(&self, number: usize) -> Line<'a> {
        Line { path: self.file.path(), number, text: "" }
    }
}

/// What stands behind a tag such as `!!opencv-matrix`.
pub(super) fn untagged<'n, 't>(node: &'n MarkedYaml<'t>) -> &'n YamlData<'t, MarkedYaml<'t>> {
    match &node.data {
        YamlData::Tagged(_, inner) => &inner.data,
        data => data,
    }
}

fn number(node: &MarkedYaml<'_>) -> Option<f64> {
    let data = untagged(node);
    data.as_floating_point()
        .or(data.as_integer().map(|whole| whole as f64))
        .filter(|number| number.is_finite())
}
