//! The file and the overrides as layers of one table, each checked by itself so that an error names where
//! the wrong text stands.

use std::ops::Range;
use std::path::{Path, PathBuf};

use toml_edit::{Document, DocumentMut, Item, Table, TableLike};

use crate::convert::{self, Invalid};
use crate::raw::Raw;
use crate::{ConfigError, GrnetdConfig, Origin, keys};

/// One `section.key=value` from the command line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Override {
    text: String,
    key: String,
    value: String,
}

impl Override {
    /// Takes `section.key=value`. The value is TOML; what is not TOML, or not of the key's type, is a string.
    ///
    /// # Errors
    /// When there is no `=` or no key before it.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let refuse = |problem: &str| ConfigError::Override { text: text.into(), problem: problem.into() };
        let (key, value) = text.split_once('=').ok_or_else(|| refuse("there is no `=`"))?;
        let (key, value) = (key.trim(), value.trim());
        if key.is_empty() {
            return Err(refuse("there is no key before the `=`"));
        }
        if key.contains(|c: char| !(c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-'))) {
            return Err(refuse("the part before the `=` is not a key"));
        }
        if value.is_empty() {
            return Err(refuse("there is no value after the `=`"));
        }
        Ok(Self { text: text.into(), key: key.into(), value: value.into() })
    }

    /// As TOML, and as TOML with the value as a string.
    fn candidates(&self) -> [String; 2] {
        let quoted = toml_edit::Value::from(self.value.as_str());
        [format!("{} = {}", self.key, self.value), format!("{} = {quoted}", self.key)]
    }
}

/// A text with where it comes from.
struct Layer {
    document: Document<String>,
    origin: LayerOrigin,
    leaves: Vec<Leaf>,
}

enum LayerOrigin {
    File(PathBuf),
    Override(String),
}

/// A known key and where it and its value stand in the text of its layer.
struct Leaf {
    key: String,
    key_span: Range<usize>,
    value_span: Range<usize>,
}

/// The file, then every override in order.
pub(crate) struct Layers {
    path: PathBuf,
    layers: Vec<Layer>,
}

impl Layers {
    pub(crate) fn new(text: &str, path: &Path, overrides: &[Override]) -> Result<Self, ConfigError> {
        let mut layers = vec![Layer::new(text.to_owned(), LayerOrigin::File(path.to_owned()))?];
        for item in overrides {
            layers.push(Layer::from_override(item)?);
        }
        Ok(Self { path: path.to_owned(), layers })
    }

    /// The file with the overrides in it.
    pub(crate) fn merged(&self) -> Table {
        let mut merged = self.layers[0].document.as_table().clone();
        for layer in &self.layers[1..] {
            for leaf in &layer.leaves {
                set(&mut merged, &leaf.key, item(layer.document.as_table(), &leaf.key));
            }
        }
        merged
    }

    pub(crate) fn config(&self) -> Result<GrnetdConfig, ConfigError> {
        let merged = self.merged();
        let raw: Raw =
            toml_edit::de::from_document(DocumentMut::from(merged)).map_err(|error| ConfigError::Syntax {
                origin: Box::new(Origin::Missing { path: self.path.clone() }),
                problem: format!("the file and the overrides do not fit together: {}", error.message()),
            })?;
        let mut config = convert::config(raw).map_err(|invalid| self.locate(invalid))?;
        self.anchor("source.path", &mut config.source.path);
        self.anchor("model.checkpoint", &mut config.model.checkpoint);
        self.anchor("record.folder", &mut config.record.folder);
        if let Some(calibration) = &mut config.source.calibration {
            self.anchor("source.calibration", calibration);
        }
        if let Some(scene) = &mut config.model.scene {
            self.anchor("model.scene", scene);
        }
        Ok(config)
    }

    /// Makes a relative path that stands in the file relative to the file's folder.
    fn anchor(&self, key: &str, value: &mut PathBuf) {
        let in_file = matches!(self.find(key), Some((Layer { origin: LayerOrigin::File(_), .. }, _)));
        if let Some(folder) = self.path.parent().filter(|_| in_file) {
            *value = folder.join(&value);
        }
    }

    /// The last layer that sets `key`, or a key inside it.
    fn find(&self, key: &str) -> Option<(&Layer, &Leaf)> {
        let inside = |leaf: &&Leaf| {
            leaf.key.strip_prefix(key).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        self.layers.iter().rev().find_map(|layer| layer.leaves.iter().find(inside).map(|leaf| (layer, leaf)))
    }

    fn locate(&self, Invalid { key, problem }: Invalid) -> ConfigError {
        let allowed = keys::find(key).map_or("see the commented example", |key| key.allowed);
        let (origin, found) = match self.find(key) {
            Some((layer, leaf)) if leaf.key == key => {
                (layer.origin(leaf.value_span.start), layer.text(&leaf.value_span))
            }
            Some((layer, leaf)) => (layer.origin(leaf.key_span.start), "(missing)".to_owned()),
            None => match self.find(key.rsplit_once('.').map_or(key, |(section, _)| section)) {
                Some((layer, leaf)) => (layer.origin(leaf.key_span.start), "(missing)".to_owned()),
                None => (Box::new(Origin::Missing { path: self.path.clone() }), "(missing)".to_owned()),
            },
        };
        ConfigError::Value { origin, key: key.into(), found, problem, allowed }
    }
}

impl Layer {
    fn new(text: String, origin: LayerOrigin) -> Result<Self, ConfigError> {
        let document = Document::parse(text.clone()).map_err(|error| ConfigError::Syntax {
            origin: origin.at(&text, error.span().map_or(0, |span| span.start)),
            problem: error.message().trim().replace('\n', "; "),
        })?;
        let mut layer = Self { document, origin, leaves: Vec::new() };
        let mut leaves = Vec::new();
        layer.walk(layer.document.as_table(), "", &mut leaves)?;
        layer.leaves = leaves;
        layer.check_types()?;
        Ok(layer)
    }

    fn from_override(item: &Override) -> Result<Self, ConfigError> {
        let [as_toml, as_string] = item.candidates().map(|text| {
            let origin = LayerOrigin::Override(item.text.clone());
            Self::new(text, origin)
        });
        // The reading as TOML is the one to complain about, unless the value is not TOML at all.
        match (as_toml, as_string) {
            (Ok(layer), _) | (Err(_), Ok(layer)) => Ok(layer),
            (Err(ConfigError::Syntax { .. }), Err(error)) | (Err(error), Err(_)) => Err(error),
        }
    }

    /// Collects the known keys; refuses the first unknown one.
    fn walk(&self, table: &dyn TableLike, prefix: &str, leaves: &mut Vec<Leaf>) -> Result<(), ConfigError> {
        for (name, item) in table.iter() {
            let path = if prefix.is_empty() { name.to_owned() } else { format!("{prefix}.{name}") };
            let key_span = table.key(name).and_then(toml_edit::Key::span).unwrap_or_default();
            let refuse = |hint: String| {
                let origin = self.origin(key_span.start);
                ConfigError::UnknownKey { origin, key: path.clone(), hint }
            };
            if keys::find(&path).is_some() {
                let value_span = item.span().unwrap_or_else(|| key_span.clone());
                leaves.push(Leaf { key: path, key_span, value_span });
            } else if !keys::is_section(&path) {
                return Err(refuse(keys::hint(&path)));
            } else if let Some(section) = item.as_table_like() {
                self.walk(section, &path, leaves)?;
            } else {
                return Err(refuse(format!("`{path}` is a section: write `[{path}]` and its keys below")));
            }
        }
        Ok(())
    }

    fn check_types(&self) -> Result<(), ConfigError> {
        let Err(error) = toml_edit::de::from_document::<Raw>(self.document.clone()) else { return Ok(()) };
        let start = error.span().map_or(0, |span| span.start);
        let problem = error.message().trim().replace('\n', "; ");
        let leaf = self.leaves.iter().find(|leaf| leaf.value_span.contains(&start));
        let Some(leaf) = leaf else {
            return Err(ConfigError::Syntax { origin: self.origin(start), problem });
        };
        Err(ConfigError::Value {
            origin: self.origin(start),
            key: leaf.key.clone(),
            found: self.text(&leaf.value_span),
            problem,
            allowed: keys::find(&leaf.key).expect("a leaf is a known key").allowed,
        })
    }

    fn origin(&self, offset: usize) -> Box<Origin> {
        self.origin.at(self.document.raw(), offset)
    }

    fn text(&self, span: &Range<usize>) -> String {
        self.document.raw()[span.clone()].to_owned()
    }
}

impl LayerOrigin {
    fn at(&self, text: &str, offset: usize) -> Box<Origin> {
        Box::new(match self {
            Self::Override(text) => Origin::Override { text: text.clone() },
            Self::File(path) => {
                let before = text.get(..offset).unwrap_or(text);
                let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
                Origin::File {
                    path: path.clone(),
                    line: before.matches('\n').count() + 1,
                    column: before[line_start..].chars().count() + 1,
                }
            }
        })
    }
}

/// The item at a known key's path.
pub(crate) fn item(table: &Table, key: &str) -> Item {
    let mut item = Item::Table(table.clone());
    for part in key.split('.') {
        item = item.get(part).cloned().unwrap_or_default();
    }
    item
}

/// Sets the item at a known key's path; the sections on the way are tables, as the walk has found.
fn set(table: &mut Table, key: &str, value: Item) {
    let mut parts: Vec<&str> = key.split('.').collect();
    let name = parts.pop().expect("a key has at least one part");
    let mut at: &mut dyn TableLike = table;
    for part in parts {
        at = at
            .entry(part)
            .or_insert_with(toml_edit::table)
            .as_table_like_mut()
            .expect("the walk has refused a section that is no table");
    }
    let value = match value.into_value() {
        Ok(value) => Item::Value(value),
        Err(item) => item,
    };
    at.insert(name, value);
}
