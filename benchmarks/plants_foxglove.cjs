// A recording as Foxglove reads it: its own libraries for the container (@mcap/core, indexed), for decompression and
// for protobuf schemas (@mcap/support). Prints one JSON object; doubles as the hexadecimal digits of their bytes.
//
//     npm install --prefix /tmp/foxglove @mcap/core@2.2.2 @mcap/nodejs@1.0.2 @mcap/support@1.1.0
//     NODE_PATH=/tmp/foxglove/node_modules node benchmarks/plants_foxglove.cjs FILE.mcap
//
// tests/oracles/test_data_foxglove.py compares the answer with what was written.
const fs = require("node:fs/promises");
const { McapIndexedReader } = require("@mcap/core");
const { FileHandleReadable } = require("@mcap/nodejs");
const { loadDecompressHandlers } = require("@mcap/support");
const { protobufFromBinaryDescriptor } = require("@mcap/support");

function bits(value) {
  const bytes = Buffer.alloc(8);
  bytes.writeDoubleBE(value);
  return bytes.toString("hex");
}

function decoderOf(schema) {
  const type = protobufFromBinaryDescriptor(schema.data).lookupType(schema.name);
  const flat = (of, message, prefix) =>
    of.fieldsArray.flatMap((field) =>
      field.type === "double"
        ? [[prefix + field.name, bits(message[field.name])]]
        : flat(field.resolve().resolvedType, message[field.name], `${prefix}${field.name}.`),
    );
  return (data) => Object.fromEntries(flat(type, type.decode(data), ""));
}

async function main(path) {
  const readable = new FileHandleReadable(await fs.open(path, "r"));
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: await loadDecompressHandlers() });
  const topics = {};
  const decoders = new Map();
  for (const channel of reader.channelsById.values()) {
    const schema = reader.schemasById.get(channel.schemaId);
    decoders.set(channel.id, decoderOf(schema));
    topics[channel.topic] = {
      message_encoding: channel.messageEncoding,
      schema_encoding: schema.encoding,
      schema: schema.name,
      metadata: Object.fromEntries(channel.metadata),
      log_times_ns: [],
      publish_times_ns: [],
      messages: [],
    };
  }
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    const topic = topics[reader.channelsById.get(message.channelId).topic];
    topic.log_times_ns.push(String(message.logTime));
    topic.publish_times_ns.push(String(message.publishTime));
    topic.messages.push(decoders.get(message.channelId)(message.data));
  }
  const metadata = {};
  for await (const record of reader.readMetadata()) metadata[record.name] = Object.fromEntries(record.metadata);
  const { messageCount, messageStartTime, messageEndTime } = reader.statistics;
  const statistics = [messageCount, messageStartTime, messageEndTime].map(String);
  console.log(JSON.stringify({ topics, metadata, statistics, chunks: reader.chunkIndexes.length }));
}

main(process.argv[2]);
