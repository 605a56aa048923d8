//! Rules of the .proto files that their compiler does not keep: comments, names, and packages that
//! change apart.

use prost::Message;
use prost_types::{FileDescriptorProto, FileDescriptorSet};
use slabcast_proto::FILE_DESCRIPTOR_SET;

const PACKAGES: [&str; 2] = ["slabcast.render.v1", "slabcast.cluster.v1"];

/// Our own files.
fn files() -> Vec<FileDescriptorProto> {
    let all = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).expect("the compiler wrote it").file;
    let ours: Vec<_> = all.into_iter().filter(|f| PACKAGES.contains(&f.package())).collect();
    assert!(PACKAGES.iter().all(|p| ours.iter().any(|f| f.package() == *p)), "both are there");
    ours
}

/// Whether the thing at a path of field numbers and places has a comment.
fn has_comment(file: &FileDescriptorProto, path: &[usize]) -> bool {
    let path: Vec<i32> = path.iter().map(|&n| n as i32).collect();
    let places = &file.source_code_info.as_ref().expect("comments are kept").location;
    places.iter().any(|place| place.path == path && !place.leading_comments().trim().is_empty())
}

/// Server reflection shows these comments, so a client in any language can do without the files.
#[test]
fn every_call_message_and_field_has_a_comment() {
    for file in files() {
        let check = |path: &[usize], name: &str| {
            assert!(
                has_comment(&file, path),
                "{}: {name} has no comment; say what it is, its unit, and what happens when it is \
                 left out",
                file.name()
            );
        };
        for (i, message) in file.message_type.iter().enumerate() {
            check(&[4, i], message.name());
            // Messages of slabcast.cluster.v1 that say that they mean what others mean, and
            // vectors.
            let elsewhere = file.name().ends_with("cluster/v1/scene.proto");
            if elsewhere || message.name() == "Vec3" {
                continue;
            }
            for (j, field) in message.field.iter().enumerate() {
                let name = format!("{}.{}", message.name(), field.name());
                // In a run of fields with one type, the comment of the first holds for all.
                let alike = j > 0 && message.field[j - 1].type_name == field.type_name;
                if !(alike && field.type_name().ends_with("SampledError")) {
                    check(&[4, i, 2, j], &name);
                }
            }
        }
        for (i, values) in file.enum_type.iter().enumerate() {
            check(&[5, i], values.name());
        }
        for (i, service) in file.service.iter().enumerate() {
            check(&[6, i], service.name());
            for (j, method) in service.method.iter().enumerate() {
                check(&[6, i, 2, j], method.name());
            }
        }
    }
}

/// The names that buf's STANDARD rules ask for.
#[test]
fn services_requests_and_enum_values_have_standard_names() {
    for file in files() {
        let folder = file.package().replace('.', "/");
        assert!(file.name().starts_with(&folder), "{} lies in {folder}", file.name());
        for service in &file.service {
            assert!(service.name().ends_with("Service"), "{}", service.name());
            for method in &service.method {
                for (used, suffix) in
                    [(method.input_type(), "Request"), (method.output_type(), "Response")]
                {
                    let want = format!(".{}.{}{suffix}", file.package(), method.name());
                    assert_eq!(used, want, "of {}", method.name());
                }
            }
        }
        for values in &file.enum_type {
            let mut prefix = String::new();
            for (i, c) in values.name().char_indices() {
                if i > 0 && c.is_uppercase() {
                    prefix.push('_');
                }
                prefix.push(c.to_ascii_uppercase());
            }
            for value in &values.value {
                let name = value.name();
                assert!(name.starts_with(&format!("{prefix}_")), "{name} of {}", values.name());
                let unspecified = name == format!("{prefix}_UNSPECIFIED");
                assert_eq!(value.number() == 0, unspecified, "{name} is {}", value.number());
            }
        }
    }
}

/// The packages change at different times: neither imports the other.
#[test]
fn packages_of_the_wire_do_not_import_each_other() {
    for file in files() {
        let folder = file.package().replace('.', "/");
        for import in &file.dependency {
            let fine = import.starts_with(&folder) || import.starts_with("google/protobuf/");
            assert!(fine, "{} imports {import}", file.name());
        }
    }
}
