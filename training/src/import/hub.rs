//! `--init`: a file, or one in a repository of the Hugging Face hub.

use std::path::{Path, PathBuf};

use super::error::ImportError;

/// Where timm and most others put their weights.
const DEFAULT_FILE: &str = "model.safetensors";

/// The file that `--init` names: a path, or `hf:owner/repository[@revision][/file]`, which is fetched into the hub's usual
/// cache (`HF_HOME`) unless it is there; revision `main` and file `model.safetensors` where they are left out.
///
/// Fetching needs the cargo feature `hf-hub`.
///
/// # Errors
/// When the file does not exist, the address cannot be read, this build cannot download or the hub does not give the file.
pub fn resolve(init: &str) -> Result<PathBuf, ImportError> {
    let bad = |problem: String| ImportError::Address { init: init.to_owned(), problem };
    match init.strip_prefix("hf:") {
        Some(address) => fetch(init, &Address::parse(address).map_err(bad)?),
        None if init.is_empty() => Err(bad("it is empty".into())),
        None if Path::new(init).is_file() => Ok(PathBuf::from(init)),
        None if Path::new(init).exists() => Err(bad("that is no file".into())),
        None => Err(bad("there is no such file".into())),
    }
}

/// A file in a repository of the hub.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Address {
    /// owner/name
    repository: String,
    revision: String,
    file: String,
}

impl Address {
    /// `owner/repository[@revision][/file]`.
    fn parse(address: &str) -> Result<Self, String> {
        let (owner, rest) = address
            .split_once('/')
            .ok_or_else(|| format!("{address:?} has no `/` between owner and repository"))?;
        let (repository, file) = rest.split_once('/').unwrap_or((rest, DEFAULT_FILE));
        let (name, revision) = repository.split_once('@').unwrap_or((repository, "main"));
        for (what, part) in [("owner", owner), ("repository", name), ("revision", revision)] {
            let allowed = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
            if part.is_empty() || part == ".." || !part.chars().all(allowed) {
                return Err(format!("the {what} {part:?} is not made of letters, digits, `-`, `_` and `.`"));
            }
        }
        // The hub's client writes below its cache by this name.
        if file.split('/').any(|part| matches!(part, "" | "." | "..")) {
            return Err(format!("{file:?} is no path of a file in a repository"));
        }
        if !file.ends_with(".safetensors") {
            return Err(format!("{file:?} is no safetensors file"));
        }
        Ok(Self {
            repository: format!("{owner}/{name}"),
            revision: revision.to_owned(),
            file: file.to_owned(),
        })
    }
}

#[cfg(not(feature = "hf-hub"))]
fn fetch(init: &str, address: &Address) -> Result<PathBuf, ImportError> {
    let Address { repository, revision, file } = address;
    let download = format!("hf download {repository} {file} --revision {revision} --local-dir .");
    Err(ImportError::NoDownload { init: init.to_owned(), download })
}

#[cfg(feature = "hf-hub")]
fn fetch(_init: &str, address: &Address) -> Result<PathBuf, ImportError> {
    fetch_with(hf_hub::api::sync::ApiBuilder::from_env(), address)
}

#[cfg(feature = "hf-hub")]
fn fetch_with(builder: hf_hub::api::sync::ApiBuilder, address: &Address) -> Result<PathBuf, ImportError> {
    let get = || {
        let Address { repository, revision, .. } = address;
        let repo = hf_hub::Repo::with_revision(repository.clone(), hf_hub::RepoType::Model, revision.clone());
        builder.build()?.repo(repo).get(&address.file)
    };
    get().map_err(|source| ImportError::Hub {
        repository: address.repository.clone(),
        revision: address.revision.clone(),
        file: address.file.clone(),
        source: Box::new(source),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> Result<(String, String, String), String> {
        Address::parse(text).map(|a| (a.repository, a.revision, a.file))
    }

    #[test]
    fn addresses() {
        let of = |r: &str, v: &str, f: &str| Ok((r.to_owned(), v.to_owned(), f.to_owned()));
        assert_eq!(
            address("timm/resnet50.a1_in1k"),
            of("timm/resnet50.a1_in1k", "main", "model.safetensors")
        );
        assert_eq!(address("a/b@v1.0"), of("a/b", "v1.0", "model.safetensors"));
        assert_eq!(
            address("a/b@0123abc/weights/x.safetensors"),
            of("a/b", "0123abc", "weights/x.safetensors")
        );
        assert_eq!(address("a/b/x.safetensors"), of("a/b", "main", "x.safetensors"));
        for (text, problem) in [
            ("resnet50", "no `/`"),
            ("/b", "owner"),
            ("a/@x", "repository"),
            ("a/b@", "revision"),
            ("a/b c", "repository"),
            ("../b", "owner"),
            ("a/b/../../x.safetensors", "no path"),
            ("a/b//x.safetensors", "no path"),
            ("a/b/model.pth", "no safetensors"),
        ] {
            let error = address(text).unwrap_err();
            assert!(error.contains(problem), "{text}: {error}");
        }
    }

    #[test]
    fn a_path_is_itself_and_what_is_none_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("weights.safetensors");
        std::fs::write(&file, "x").unwrap();
        assert_eq!(resolve(file.to_str().unwrap()).unwrap(), file);
        for (init, problem) in [
            ("", "empty"),
            (folder.path().to_str().unwrap(), "no file"),
            ("/nowhere/resnet50.safetensors", "no such file"),
            ("hf:resnet50", "owner and repository"),
        ] {
            let error = resolve(init).unwrap_err().to_string();
            assert!(error.contains(problem) && error.contains("hf:owner/repository"), "{error}");
        }
    }

    #[cfg(not(feature = "hf-hub"))]
    #[test]
    fn without_the_feature_the_error_names_it_and_another_way() {
        let error = resolve("hf:timm/resnet50.a1_in1k@v2").unwrap_err().to_string();
        assert!(error.contains("--features hf-hub"), "{error}");
        let download = "hf download timm/resnet50.a1_in1k model.safetensors --revision v2";
        assert!(error.contains(download), "{error}");
    }

    #[cfg(feature = "hf-hub")]
    #[test]
    fn a_file_in_the_cache_needs_no_network_and_a_silent_hub_is_named() {
        use hf_hub::{Cache, api::sync::ApiBuilder};
        let folder = tempfile::tempdir().unwrap();
        let repository = folder.path().join("models--a--b");
        let snapshot = repository.join("snapshots/0123");
        std::fs::create_dir_all(&snapshot).unwrap();
        std::fs::create_dir_all(repository.join("refs")).unwrap();
        std::fs::write(repository.join("refs/main"), "0123").unwrap();
        std::fs::write(snapshot.join("model.safetensors"), "x").unwrap();
        // Nobody listens on a port that was just given back.
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let builder = || {
            ApiBuilder::from_cache(Cache::new(folder.path().to_owned()))
                .with_endpoint(format!("http://127.0.0.1:{port}"))
                .with_retries(0)
        };
        let get = |text: &str| fetch_with(builder(), &Address::parse(text).unwrap());
        assert_eq!(get("a/b").unwrap(), snapshot.join("model.safetensors"));
        let error = get("a/b@v2/x.safetensors").unwrap_err();
        assert!(error.to_string().contains("x.safetensors of a/b at v2"), "{error}");
        assert!(std::error::Error::source(&error).is_some());
    }
}
