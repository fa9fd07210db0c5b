//! The value of every key, so that two configurations can be compared key by key.

use std::collections::BTreeMap;
use std::path::Path;

use toml_edit::{Item, Value};

use crate::layers::{Layers, item};
use crate::{ConfigError, KEYS, Override};

/// The commented example: every key with its default.
pub const EXAMPLE: &str = include_str!("../grnetd.toml");

/// What a configuration says about every key, its default where it says nothing.
///
/// ```
/// use grnet_config::Settings;
/// let settings = |text| Settings::parse(text, "grnetd.toml".as_ref(), &[]).unwrap();
/// let (old, new) = (settings("log.level = 'info'"), settings("source.loop = true"));
/// assert_eq!(old.differences(&new), ["source.loop"]);
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Settings(BTreeMap<&'static str, String>);

impl Settings {
    /// What `text`, which stands in the file `path`, and the overrides say.
    ///
    /// # Errors
    /// See [`ConfigError`]: the text is not TOML, or has an unknown key or a value of the wrong type.
    pub fn parse(text: &str, path: &Path, overrides: &[Override]) -> Result<Self, ConfigError> {
        let defaults = Self::of(&Layers::new(EXAMPLE, "grnetd.toml".as_ref(), &[])?);
        let Self(mut all) = Self::of(&Layers::new(text, path, overrides)?);
        for (key, default) in defaults.0 {
            all.entry(key).or_insert(default);
        }
        Ok(Self(all))
    }

    fn of(layers: &Layers) -> Self {
        let merged = layers.merged();
        let values = KEYS.iter().filter_map(|key| Some((key.path, of_item(&item(&merged, key.path))?)));
        Self(values.collect())
    }

    /// The keys that have another value in `other`, in the order of the example.
    pub fn differences(&self, other: &Self) -> Vec<&'static str> {
        KEYS.iter().map(|key| key.path).filter(|key| self.0.get(key) != other.0.get(key)).collect()
    }

    /// Takes over the value of `key`.
    pub fn adopt(&mut self, key: &'static str, other: &Self) {
        match other.0.get(key) {
            Some(value) => self.0.insert(key, value.clone()),
            None => self.0.remove(key),
        };
    }
}

fn of_item(item: &Item) -> Option<String> {
    item.clone().into_value().ok().map(|value| of_value(&value))
}

/// One text for each meaning: spaces, quotes, the order of tables and `1` for `1.0` make no difference.
fn of_value(value: &Value) -> String {
    match value {
        Value::Integer(number) => (*number.value() as f64).to_string(),
        Value::Float(number) => number.value().to_string(),
        Value::String(text) => format!("{:?}", text.value()),
        Value::Boolean(truth) => truth.value().to_string(),
        Value::Datetime(time) => time.value().to_string(),
        Value::Array(list) => format!("[{}]", list.iter().map(of_value).collect::<Vec<_>>().join(",")),
        Value::InlineTable(table) => {
            let mut entries: Vec<_> =
                table.iter().map(|(key, value)| format!("{key}={}", of_value(value))).collect();
            entries.sort_unstable();
            format!("{{{}}}", entries.join(","))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(text: &str) -> Settings {
        Settings::parse(text, Path::new("grnetd.toml"), &[]).unwrap()
    }

    #[test]
    fn what_means_the_same_is_no_difference() {
        let all = settings(EXAMPLE);
        assert_eq!(settings("").differences(&all), <[&str; 0]>::default());
        let a = settings("[source]\nrate_hz = 30\ncontrols = { a = 1, b = 2 }\n[log]\nlevel = 'info'");
        let b = settings("[source.controls]\nb = 2\na = 1\n[source]\nrate_hz = 30.0");
        assert_eq!(a.differences(&b), <[&str; 0]>::default());
    }

    #[test]
    fn a_difference_is_named_and_can_be_adopted() {
        let override_ = Override::parse("log.level=debug").unwrap();
        let mut old = settings("[model]\nscene = 'a'\n[source]\ncontrols = { a = 1 }");
        let new = Settings::parse("source.controls = { a = 2 }", Path::new("g.toml"), &[override_]).unwrap();
        assert_eq!(old.differences(&new), ["source.controls", "model.scene", "log.level"]);
        old.adopt("model.scene", &new);
        old.adopt("log.level", &new);
        assert_eq!(old.differences(&new), ["source.controls"]);
    }
}
